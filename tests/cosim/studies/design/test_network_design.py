"""``noack design --for network``: what is found is proven, and no worse than what was given.

``tests/noack/theory/certificates/certificate_kinds/designs.py`` attacks what is said of random loops.
"""

import json
import shlex
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from cosim.simulation.virtual_time import simulate
from cosim.studies.design.design_outcome import DesignOutcome, periodic_outcome
from cosim.studies.design.event_design import (
    CertifiedEventLoop,
    EventSearch,
    design_for_network,
    event_outcome,
)
from cosim.studies.design.hold_strategies import read_holds
from cosim.studies.design.network_search import CertifiedLoop, DesignRequest, NetworkSearch
from noack.guarantee.loss_guarantee import LossesInWindow
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.certificates.conditions import nominal_conditions
from noack.theory.certificates.scenario_certificates import certify_box
from noack.theory.margins.loss_margin import LossMargin
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


class FoundEvents(NamedTuple):
    """The same of a loop with events."""

    search: EventSearch
    given: CertifiedEventLoop
    best: CertifiedEventLoop
    shown: DesignOutcome


def searched(given: Scenario, request: DesignRequest) -> Found:
    search = NetworkSearch(given, request)
    loops = search.run()
    return Found(search, *loops, periodic_outcome(search, *loops))


def searched_events(given: Scenario, request: DesignRequest, seed: int) -> FoundEvents:
    search = EventSearch(given, request, seed, draws=80)
    loops = search.run()
    return FoundEvents(search, *loops, event_outcome(search, *loops))


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
    more = pole.search.scenario_of(pole.best.candidate, pole.best.level + 1)
    kept = pole.best.stability
    assert kept is not None
    assert final_size(more, kept.pattern) < 1e-3
    assert final_size(more, (True, False, False, True, False)) < 1e-3
    assert final_size(more, beyond.pattern) > 1e3


@pytest.mark.parametrize(
    ("name", "settings", "design_request"),
    [
        ("lane_periodic", (), DesignRequest(effort=0, most=7)),
        ("lane_periodic", (), DesignRequest(effort=0, window=7)),
        ("unstable_pendulum", (), DesignRequest(effort=80, period_s=PERIOD_S, holds=read_holds("model"))),
        (
            "unstable_pendulum",
            ("mode=zoh",),
            DesignRequest(effort=30, period_s=PERIOD_S, holds=read_holds("zoh")),
        ),
        ("unstable_pendulum", ZERO, DesignRequest(effort=60, period_s=PERIOD_S, holds=read_holds("zero"))),
        ("double_integrator", ("network.mansd=2",), DesignRequest("transmissions", period_s=1, effort=30)),
    ],
)
def test_no_design_is_worse_than_what_was_given_and_each_is_proven(
    name: str, settings: tuple[str, ...], design_request: DesignRequest
) -> None:
    outcome = searched(shipped(name, *settings), design_request)
    given, best = outcome.given, outcome.best
    assert best.level >= given.level
    assert best.cost <= outcome.search.cost_limit or best == given
    if best.level >= 0:
        assert best.stability is not None
        assert LossMargin(resolve(outcome.shown.scenario)).coarse_bounds().upper < 1
    if name != "double_integrator":
        assert best.level > given.level
    if design_request.window:
        assert isinstance(outcome.shown.scenario.network.guarantee.rules[-1], LossesInWindow)


def test_each_hold_strategy_has_the_most_that_its_best_loop_reached() -> None:
    outcome = searched(
        shipped("lane_periodic"), DesignRequest(effort=0, most=8, holds=read_holds("zoh,model"))
    )
    (hold, of_hold), (model, of_model) = outcome.shown.by_hold
    assert (hold, model, of_model) == ("hold", "the model's input", "M = 8")
    alone = searched(shipped("lane_periodic"), DesignRequest(effort=0, most=8, holds=read_holds("zoh")))
    assert of_hold == f"M = {alone.best.level + 1}"
    assert alone.best.level < outcome.best.level
    assert outcome.shown.to_json()["highest_by_hold"] == {hold: of_hold, model: of_model}


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
        invoke("margin", out, "--no-period", "--most", 4, "--accuracy", 0.02, "--json").stdout
    )
    assert decided["stable_m"] == outcome["best"]["certified"] == 3
    assert decided["mansd"] == 2
    pasted = tmp_path / "pasted.toml"
    pasted.write_text(outcome["lines"])
    assert f"gain = [\n  {list(outcome['best']['K'][0])},\n]".replace("[[", "[") in outcome["lines"]


@pytest.mark.parametrize(
    ("word", "mode", "timeout_s", "timeout_input"),
    [
        ("zero", "zoh", 0.252, "safe"),
        ("predictions:2", "model", 0.502, "safe"),
        ("predictions:1:hold", "model", 0.252, "hold"),
    ],
)
def test_each_hold_strategy_is_written_decided_and_run_as_claimed(
    word: str, mode: str, timeout_s: float, timeout_input: str
) -> None:
    """Repeated patterns of the M that is proven vanish in a run, one of the next M grows."""
    scenario = shipped("unstable_pendulum", "mode=zoh", "controller.safe_input=[0.1]")
    outcome = searched(scenario, DesignRequest(period_s=PERIOD_S, effort=0, holds=read_holds(word), cost=50))
    best, written_scenario = outcome.best, validate(tomllib.loads(outcome.shown.scenario_toml()), "written")
    assert best.candidate.hold in read_holds(word)
    assert (written_scenario.mode, written_scenario.controller.update_timeout_s) == (mode, timeout_s)
    assert (written_scenario.controller.timeout_input, written_scenario.controller.safe_input) == (
        timeout_input,
        None,
    )
    assert LossMargin(resolve(written_scenario)).coarse_bounds().verdict == "stable"
    assert best.stability is not None
    assert best.beyond is not None
    assert final_size(written_scenario, best.stability.pattern) < 0.3
    assert final_size(written_scenario, best.beyond.pattern) > 1e2


def test_the_holds_that_are_named_decide_also_about_the_given_timeout() -> None:
    given = ("controller.update_timeout_s=0.752", "mode=model")
    request = DesignRequest(period_s=PERIOD_S, effort=0, holds=read_holds("zero"), cost=50)
    outcome = searched(shipped("unstable_pendulum", *given), request)
    assert outcome.best.candidate.hold in read_holds("zero")
    assert outcome.best.level < outcome.given.level
    assert any("--holds excludes its strategy" in note for note in outcome.shown.notes)
    assert outcome.shown.given.cells["between updates"].endswith(" (not in --holds)")
    repetition = searched(shipped("unstable_pendulum", *ZERO), request)
    assert repetition.search.keeps_given_hold
    assert repetition.best.level >= repetition.given.level


def test_a_period_between_two_measurements_is_said_to_be_longer() -> None:
    outcome = searched(shipped("unstable_pendulum"), DesignRequest(period_s=0.2503, effort=0, most=1))
    assert "--period 0.2503: updates are sent at measurements, every 0.252 s" in outcome.shown.notes


def test_a_file_that_is_no_scenario_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "notes.toml"
    path.write_text("mine = 1")
    result = invoke("design", "lane_periodic", "--for", "network", "--out", path)
    assert result.stderr == f"noack: --out {path}: exists, and is no scenario; give another name\n"
    assert path.read_text() == "mine = 1"


@pytest.fixture(scope="module")
def events() -> FoundEvents:
    """The pendulum's own trigger and gain, and better ones, with a certified bound of ‖x‖."""
    request = DesignRequest(most=40, bounds={"state": 1.6}, effort=50)
    return searched_events(shipped("unstable_pendulum"), request, seed=5)


def test_a_loop_with_events_is_certified_for_more_losses_within_its_limits(
    events: FoundEvents,
) -> None:
    search, best = events.search, events.best
    assert best.m > events.given.m > 1
    assert search.of_box
    resolved = resolve(events.shown.scenario)
    conditions = nominal_conditions(resolved, resolved.certificate.late_periods)
    certificate = certify_box(resolved, conditions)
    assert certificate is not None
    assert certificate.constants is not None
    assert certificate.constants.state <= 1.6
    assert search.state_bound(best.loop, best.m + 1) > 1.6
    measured = search.measure(best.loop, search._draws)
    assert measured.cost <= search.limits.cost
    assert measured.transmissions <= search.limits.transmissions
    # Means of fresh draws differ by their own spread.
    assert best.measured.transmissions == pytest.approx(measured.transmissions, rel=0.1)


def test_fewer_transmissions_of_events_for_the_same_network() -> None:
    given = shipped("double_integrator")
    outcome = searched_events(given, DesignRequest("transmissions", effort=50), seed=1)
    assert outcome.shown.scenario.network == given.network
    assert outcome.best.measured.transmissions < 0.9 * outcome.given.measured.transmissions
    assert outcome.search.certificate(outcome.best.loop, given.network.mansd + 1) is not None
    assert outcome.best.m >= given.network.mansd + 1


@pytest.mark.parametrize("losses", [0, 2])
@pytest.mark.parametrize("period_s", [None, 2.0])
def test_no_m_is_examined_beyond_what_a_constraint_allows(losses: int, period_s: float | None) -> None:
    constraint = f'network.constraints=[{{kind="at_most", losses={losses}, window=10}}]'
    scenario = shipped("double_integrator", constraint)
    shown = design_for_network(scenario, DesignRequest(period_s=period_s, effort=0, most=4))
    assert shown.given.document["certified"] == shown.best.document["certified"] == losses + 1


def test_a_plant_outside_its_box_is_certified_itself() -> None:
    box = "plant.uncertainty_B=[[0.0], [0.1]]"
    outside = 'plant.draw="given"', "plant.A=[[0.0, 1.0], [0.0, 0.0]]", "plant.B=[[0.0], [1.2]]"
    assert EventSearch(shipped("double_integrator", box), DesignRequest(), 0, draws=20).of_box
    assert not EventSearch(shipped("double_integrator", box, *outside), DesignRequest(), 0, draws=20).of_box


def test_a_given_loop_that_diverges_sets_no_limit() -> None:
    unstable = "model.gain=[[5.0, 5.0]]", "model.allow_unstable=true"
    search = EventSearch(shipped("double_integrator", *unstable), DesignRequest(most=1), 0, draws=20)
    assert search.excess(search.original._replace(K=((-1.0, -1.4),))) < 0


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
