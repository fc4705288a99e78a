"""How many loops a link carries: against R h / bits, with its limits, figures and mistakes."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from typer.testing import CliRunner

from cosim.cli import app
from cosim.studies.campaign.campaign_grid import grid
from cosim.studies.campaign.campaign_run import run_campaign
from cosim.studies.campaign.campaign_summary import summarise
from cosim.studies.campaign.campaign_workers import alone
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.loops_draws import used_up
from cosim.studies.capacity import capacity_plan as plans
from cosim.studies.capacity.capacity_criteria import PolicyCapacity, capacities, carried
from cosim.studies.capacity.capacity_page import CapacityResult, comparisons, figures
from noack.config.scenario_file import load
from noack.protocol.record_tables import Fate

FILE = Path(__file__).parents[4] / "scenarios" / "shared_bottleneck.toml"
PERIOD_S = 0.1
BITS = 8 * (28 + 64)
"""Bits of an update of two states on the link: UDP and IPv4, and the datagram of docs/wire.md."""
SHORT = ("--set", "horizon_s=1.0", "--set", "plant.rate_hz=50", "--set", "controller.rate_hz=50")


def study(tmp_path: Path, queue: int, deadline_s: float = PERIOD_S) -> CapacityResult:
    """Periodic loops on a link that carries exactly six of them."""
    rate_bps = round(6 * BITS / PERIOD_S)
    stage = f"network.impairments=[{{ kind = 'rate', rate_bps = {rate_bps}, queue = {queue} }}]"
    scenario = load(FILE, [stage, "network.loss.probability=0.0"])
    settings = {
        "horizon_s": 3.0,
        "network.impairments": [{"kind": "rate", "rate_bps": rate_bps, "queue": queue}],
        "network.loss.probability": 0.0,
        "certificate.network_delay_s": deadline_s,
        "loops": [{"name": "loop"}],
    }
    policies = plans.default_policies(scenario, PERIOD_S)
    plan = plans.CapacityPlan(
        scenario.model_copy(update={"loops": None, "horizon_s": 3.0}), FILE, settings, rate_bps,
        PERIOD_S, deadline_s, (1, 6, 7), {"periodic": policies["periodic"]}, 0.0, 2, 5,
    )  # fmt: skip
    campaign = plan.campaign()
    store = Store(tmp_path, grid(campaign, Path("study")), plan.draws, 1)
    run_campaign(store, alone)
    summary = summarise(campaign, store)
    return CapacityResult(plan, summary, capacities(summary, store), [])


def limits_of(result: CapacityResult) -> tuple[PolicyCapacity, dict[str, float]]:
    (found,) = result.capacities
    return found, {name: one.median for name, one in found.limits.items()}


def test_a_short_queue_carries_as_many_periodic_loops_as_the_rate_allows(tmp_path: Path) -> None:
    result = study(tmp_path, queue=6, deadline_s=2 * PERIOD_S)
    assert result.plan.periodic_loops == pytest.approx(6.0, rel=1e-6)
    found, limits = limits_of(result)
    # The seventh loop overflows the queue of six, in which updates wait for about a period.
    assert found.any_limit.median == limits["guarantee"] == 6
    assert limits["deadline"] == np.inf
    assert found.limited_by == "guarantee"


def test_a_long_queue_delays_what_it_does_not_drop(tmp_path: Path) -> None:
    found, limits = limits_of(study(tmp_path, queue=100))
    assert found.any_limit.median == limits["deadline"] == 6
    assert limits["guarantee"] == np.inf


def test_a_figure_shows_the_means_of_the_summary(tmp_path: Path) -> None:
    result = study(tmp_path, queue=100)
    drawn = {name: figure for name, figure, _ in figures(result)}
    assert [*drawn] == ["guarantee-own", "deadline-own", "cost-own"]
    (axes,) = drawn["deadline-own"].axes
    means = [one.estimates["updates_late"].mean for one in result.summary.found]
    curve, fitting = axes.lines
    assert np.asarray(curve.get_ydata()).tolist() == means
    assert means[:2] == [0.0, 0.0]
    assert means[2] > 0.5
    assert np.asarray(fitting.get_xdata())[0] == pytest.approx(6.0, rel=1e-6)
    assert list(comparisons(result)) == []


def test_a_draw_carries_the_loops_before_the_first_limit() -> None:
    reached = np.array([
        [False, False, True, False],
        [False, True, False, False],
        [True, False, False, False],
    ])  # fmt: skip
    assert carried([1, 4, 9], reached).tolist() == [4, 1, 0, np.inf]


def test_the_guarantee_is_used_up_by_a_burst_with_a_full_queue() -> None:
    letters = {"d": Fate.DELIVERED, "f": Fate.FORCED, "x": Fate.DROPPED, "o": Fate.OVERFLOWED}
    random = np.random.default_rng(3)
    seen = set()
    for _ in range(300):
        text = "".join(random.choice([*letters], 12))
        burst = int(random.integers(1, 5))
        bursts = re.findall("[xo]+", text)
        expected = any(len(one) >= burst and "o" in one for one in bursts)
        assert used_up(np.array([letters[one] for one in text]), burst) == expected, (text, burst)
        seen.add(expected)
    assert seen == {True, False}


def capacity(*words: str) -> Result:
    return CliRunner().invoke(app, ["capacity", *words])


def test_loops_with_settings_of_their_own_are_named() -> None:
    drawn = load(FILE, ["loops=[{ name = 'a', count = 3, phase = 0.5, seeds = { noise = 1 } }]"])
    assert plans.loops_with_own_settings(drawn) == []
    own = load(FILE, ["loops=[{ name = 'a' }, { name = 'b', mode = 'zoh' }]"])
    assert plans.loops_with_own_settings(own) == ["b"]


def test_the_command_compares_the_policies_and_confirms_a_point_live(tmp_path: Path) -> None:
    result = capacity(
        str(FILE), "--loops", "2", "--draws", "1", "--workers", "1", "--json", *SHORT,
        "--rate-bps", "60000", "--policy", "slow={ policy = 'periodic', period_s = 0.5 }",
        "--confirm", "model=2", "--out", str(tmp_path),
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert {one["policy"] for one in found["capacities"]} == {"periodic", "zoh", "model", "slow"}
    assert {one["disturbance"] for one in found["capacities"]} == {"as in the scenario", "common"}
    assert len(found["comparisons"]) == 6
    (live,) = found["live"]
    assert (live["policy"], live["loops"], live["status"]) == ("model", 2, 0)
    assert live["values"]["transmissions"] > 0
    assert "crosses are live runs" in (tmp_path / "capacity.html").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--set", "network.impairments=[]"], "no bottleneck that the loops could share"),
        (["--loops", "0,3"], "numbers of loops are at least 1"),
        (["--loops", "few"], "--loops few: write it as"),
        (["--update-period", "99"], "--update-period 99: between 0 and the horizon"),
        (
            ["--update-period", "0.015"],
            "0.015: not a multiple of the time between two measurements",
        ),
        (["--set", "model.gain=[[-3.0, -0.001]]", "--set", "horizon_s=0.2"], "give a period"),
        (["--policy", "zoh={}"], "with a new name"),
        (["--policy", " zoh={}"], "with a new name"),
        (["--policy", "../x={ policy = 'periodic', period_s = 0.2 }"], "letters, digits"),
        (["--set", "trigger={ policy = 'periodic', period_s = 0.2 }"], "need an event-triggered"),
    ],
)
def test_a_mistake_is_one_line(words: list[str], message: str, tmp_path: Path) -> None:
    result = capacity(str(FILE), "--out", str(tmp_path / "study"), *words)
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "study").exists()


def test_a_point_that_the_study_does_not_have_is_refused_before_it_runs(tmp_path: Path) -> None:
    result = capacity(str(FILE), "--out", str(tmp_path / "study"), *SHORT, "--confirm", "model=77")
    assert result.exit_code == 2
    assert "--confirm model=77: no such point" in result.stderr
    assert not (tmp_path / "study").exists()
