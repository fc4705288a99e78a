"""The command: its announcement and documents, a point confirmed live, a schedule."""

import json
import re
from pathlib import Path

import pytest
from click.testing import Result

from cosim.studies.capacity import capacity_plan as plans
from tests.cosim.studies.capacity.conftest import FILE, LOOP
from tests.helpers.command_line import invoke

SHORT = ("--set", "horizon_s=1.0", "--set", "plant.rate_hz=50", "--set", "controller.rate_hz=50")


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands without page and figures, which take longer than small studies."""
    monkeypatch.setattr("cosim.studies.capacity.capacity_page.write", lambda *_: [])


def capacity(*words: str) -> Result:
    return invoke("capacity", *words)


@pytest.mark.usefixtures("no_page")
def test_the_default_answers_for_the_shipped_mixture_and_says_how_long_it_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert plans.QUICK.draws == 6
    monkeypatch.setattr(plans, "QUICK", plans.QUICK._replace(draws=1))
    options = "--out", str(tmp_path), "--workers", "1", "--json", "--set", "horizon_s=0.2"
    result = capacity("shared_bottleneck", *options, *SHORT[2:])
    assert result.exit_code == 0, result.output
    assert re.search(
        r"18 runs of 0.2 s with 11 to 33 loops; the simulation takes about \d+ s on an idle core; "
        r"--thorough: \d+ (s|min)\n",
        result.stderr,
    )
    document = json.loads(result.stdout)
    assert (document["loops"], document["draws"], document["thorough"]) == ([11, 22, 33], 1, False)
    for row in document["capacities"]:
        if row["median"] is not None:
            assert row["loops_by_kind"]["pendulum"] == 10 * row["factor"] == row["median"] / 1.1
    repetition = capacity("shared_bottleneck", *options, *SHORT[2:])
    assert repetition.exit_code == 0
    assert json.loads(repetition.stdout)["made"] == 0
    assert "takes about" not in repetition.stderr


@pytest.mark.usefixtures("without_viewer", "no_drawing")
def test_the_command_compares_the_policies_and_confirms_a_point_live(tmp_path: Path) -> None:
    result = capacity(
        str(FILE), "--set", LOOP, "--loops", "2", "--draws", "1", "--disturbance", "1",
        "--workers", "1", "--json", *SHORT,
        "--rate-bps", "60000", "--policy", "slow={ policy = 'periodic', period_s = 0.5 }",
        "--confirm", "model=2", "--out", str(tmp_path),
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert {row["policy"] for row in document["capacities"]} == {"periodic", "zoh", "model", "slow"}
    assert {row["disturbance"] for row in document["capacities"]} == {
        "as in the scenario",
        "common",
    }
    assert len(document["comparisons"]) == 6
    (live,) = document["live"]
    assert (live["policy"], live["loops"], live["status"]) == ("model", 2, 0)
    assert live["values"]["transmissions"] > 0
    assert "crosses are live runs" in (tmp_path / "capacity.html").read_text()


@pytest.mark.usefixtures("no_page")
def test_a_schedule_carries_as_many_loops_as_its_delay_allows(tmp_path: Path) -> None:
    """Loops that transmit every 60 ms, or every 20 ms, in turn in slots of 10 ms; M = 4, Q = 1."""
    result = capacity(
        "scheduled_channel", "--loops", "2,5,9", "--draws", "2",
        "--update-period", "0.06", "--late-after", "0.05",
        "--set", "network.impairments.0.slot_s=0.01", "--set", "network.loss.probability=0",
        "--workers", "1", "--json", "--out", str(tmp_path), *SHORT,
    )  # fmt: skip
    document = json.loads(result.stdout)
    assert document["periodic_loops_by_rate"] == pytest.approx(6.0)
    inf = None  # of JSON
    assert document["delay_bounds_s"]["periodic"] == pytest.approx([0.01, 0.02, 0.05, 0.18])
    assert document["delay_bounds_s"]["model"] == pytest.approx([0.01, 0.02, 0.1, inf])
    row, *_ = document["capacities"]
    assert (row["policy"], row["median"]) == ("periodic", 5.0)
    assert result.exit_code == 0
