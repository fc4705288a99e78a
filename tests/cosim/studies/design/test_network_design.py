"""``noack design --for network``: what is found is proven, and no worse than what was given."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from cosim.simulation.virtual_time import simulate
from cosim.studies.design.design_outcome import DesignOutcome, network_outcome
from cosim.studies.design.network_search import CertifiedLoop, DesignRequest, NetworkSearch
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.theory.witnesses.loss_margin import LossMargin
from tests.helpers.approved import compare_lines
from tests.helpers.command_line import invoke
from tests.helpers.shipped import shipped

ROOT = Path(__file__).parents[4]
ZERO = "mode=zoh", "controller.update_timeout_s=0.252"
LINEAR = 'plant.system={kind="linear"}'
PERIOD_S = 0.25


class Found(NamedTuple):
    """A search with its loops and what is shown of them."""

    search: NetworkSearch
    given: CertifiedLoop
    best: CertifiedLoop
    shown: DesignOutcome


def searched(given: Scenario, request: DesignRequest) -> Found:
    search = NetworkSearch(given, request)
    loops = search.run()
    return Found(search, *loops, network_outcome(search, *loops))


def final_size(scenario: Scenario, pattern: Sequence[bool]) -> float:
    """‖x‖ at the end of a simulated run of the processes under a pattern, repeated."""
    resolved = resolve(scenario.model_copy(update={"horizon_s": 120.0}))
    numbers = iter(range(100_000))
    run = simulate(resolved, lambda data, now_ns: 0 if pattern[next(numbers) % len(pattern)] else None)
    return float(np.linalg.norm(run["plant_step"]["x"][-1]))


@pytest.fixture(scope="module")
def pole() -> Found:
    """The pole on a cart."""
    request = DesignRequest(period_s=PERIOD_S, effort=5)
    return searched(shipped("cart_pole", LINEAR), request)


def test_the_next_guarantee_is_destabilised_by_the_pattern_that_is_shown(
    pole: Found,
) -> None:
    beyond = pole.best.beyond
    assert beyond is not None
    assert beyond.verdict == "destabilised"
    more = pole.search.scenario_of(pole.best.K, pole.best.mansd + 1)
    kept = pole.best.stability
    assert kept is not None
    assert final_size(more, kept.pattern) < 1e-3
    assert final_size(more, (True, False, False, True, False)) < 1e-3
    assert final_size(more, beyond.pattern) > 1e3


@pytest.mark.parametrize(
    ("name", "settings", "design_request"),
    [
        ("lane_periodic", (), DesignRequest(effort=0, most=6)),
        ("unstable_pendulum", (), DesignRequest(effort=80, period_s=PERIOD_S)),
        ("unstable_pendulum", ("mode=zoh",), DesignRequest(effort=30, period_s=PERIOD_S)),
        ("unstable_pendulum", ZERO, DesignRequest(effort=60, period_s=PERIOD_S)),
    ],
)
def test_no_design_is_worse_than_what_was_given_and_each_is_proven(
    name: str, settings: tuple[str, ...], design_request: DesignRequest
) -> None:
    outcome = searched(shipped(name, *settings), design_request)
    given, best = outcome.given, outcome.best
    assert best.mansd > given.mansd
    assert best.cost <= outcome.search.cost_limit
    assert best.stability is not None
    assert LossMargin(resolve(outcome.shown.scenario)).coarse_bounds().upper < 1


def test_the_written_scenario_is_checked_and_decided_as_claimed(tmp_path: Path, pole: Found) -> None:
    """A second search of the same loop has the same result."""
    out, page = tmp_path / "out.toml", tmp_path / "p.html"
    result = invoke(
        "design", ROOT / "scenarios" / "cart_pole.toml", "--set", LINEAR, "--for", "network",
        "--period", PERIOD_S, "--effort", 5, "--out", out, "--page", page, "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    outcome = json.loads(result.stdout)
    assert outcome.pop("files") == [str(page), str(out)]
    assert outcome == json.loads(json.dumps(pole.shown.to_json()))
    assert "<svg" in page.read_text()
    assert invoke("check", out).exit_code == 0
    decided = json.loads(
        invoke("margin", out, "--no-period", "--most", 3, "--accuracy", 0.02, "--json").stdout
    )
    assert decided["stable_mansd"] == outcome["best"]["certified"] == 2
    assert decided["mansd"] == 2
    pasted = tmp_path / "pasted.toml"
    pasted.write_text(outcome["lines"])
    assert f"gain = [\n  {list(outcome['best']['K'][0])},\n]".replace("[[", "[") in outcome["lines"]


def test_the_lines_about_mistakes_are_those_that_were_approved(tmp_path: Path) -> None:
    def mistake(line: str) -> list[str]:
        words = shlex.split(line)
        words[0] = str(ROOT / "scenarios" / f"{words[0]}.toml")
        result = invoke("design", *words, "--page", tmp_path / "p.html")
        assert result.exit_code == 2, result.output
        assert result.stderr.count("\n") == 1
        return [result.stderr.strip()]

    compare_lines(Path(__file__).with_name("network_mistakes.txt"), mistake)
    assert not [*tmp_path.iterdir()]
