"""Updates that arrive at a tick of the controller act at this tick or at the next one, anew each time."""

from pathlib import Path

import numpy as np
import pytest

from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario import arrival_ties
from noack.scenario.arrival_ties import with_later_updates
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.witnesses.growth import enclose_growth
from noack.theory.witnesses.loss_margin import LossMargin, capped
from noack_check.check import RejectedError
from noack_check.growth import LATENCY_NS, Burst, prove_growth
from tests.checker.runs import floats

CASE = Path(__file__).parents[1] / "cases" / "drive_tie.toml"
"""A packet every 10 ms arrives 25 ms later, at a tick of the controller, 5 ms after a transmission."""
LATER = 'network.impairments=[{kind="delay", delay_s=0.02508}]'
BEFORE = 'network.impairments=[{kind="delay", delay_s=0.02495}]'
NEAR_THE_NEXT = ("controller.phase=0.0", 'network.impairments=[{kind="delay", delay_s=0.0299}]')


def margin(*settings: str) -> LossMargin:
    return LossMargin(resolve(load(CASE, list(settings))))


@pytest.mark.parametrize(
    ("settings", "arrivals"),
    [
        ((), [5_000_000, 5_000_001]),
        ((LATER,), [5_080_000, 5_000_000]),
        ((BEFORE,), [4_950_000, 5_000_001]),
        (("controller.phase=0.25",), [5_000_000]),
        (("network.impairments=[]",), [0]),
        (("network.impairments=[]", "controller.phase=0.0"), [0, 1]),
    ],
)
def test_an_arrival_near_a_tick_has_both_outcomes(settings: tuple[str, ...], arrivals: list[int]) -> None:
    loop = margin(*settings)
    assert loop.loop.times.arrivals(0) == arrivals
    assert bool(loop.ties) == (len(arrivals) > 1)


def test_an_arrival_that_may_be_in_the_next_period_is_refused() -> None:
    with pytest.raises(CallerError, match=r"of a transmission and of a tick; change controller\.phase"):
        margin(*NEAR_THE_NEXT)


def test_either_outcome_is_that_of_a_loop_without_the_tie() -> None:
    """A loop whose delay is 5 µs more or less has the same outcomes, the other way round."""
    tied, later = margin().loop, margin(LATER).loop
    for units in (1, 3):
        for mine, other in zip(tied.times.arrivals(0), reversed(later.times.arrivals(0)), strict=True):
            ours = floats(tied.matrix(Burst(0, 0, 0, tied.times.latest, units - 1, units, mine)))
            theirs = floats(later.matrix(Burst(0, 0, 0, later.times.latest, units - 1, units, other)))
            np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_more_losses_are_not_proven_than_with_both_outcomes() -> None:
    """With early arrivals alone 13 losses are proven, and are false of a live run."""
    loop = margin()
    assert loop.stability(capped(loop.guarantee, 3), 0.03).verdict == "stable"
    assert loop.stability(capped(loop.guarantee, 13), 0.03, effort=0.1).verdict != "stable"


def test_a_witness_names_the_outcomes_of_its_pattern() -> None:
    loop = margin().loop
    found = enclose_growth(loop, 0.03, decide=False)
    assert found.unstable is not None
    table = dict(found.unstable["unstable"])  # type: ignore[call-overload]
    deliveries = table["pattern"].count("D")
    for arrivals in ([2] * deliveries, [0] * (deliveries + 1), [True] * deliveries, "0"):
        with pytest.raises(RejectedError, match="arrivals"):
            prove_growth(loop, {**found.unstable, "unstable": {**table, "arrivals": arrivals}})


def test_a_simulation_takes_the_later_tick_and_says_so() -> None:
    assert arrival_ties.LATENCY_NS == LATENCY_NS
    scenario, text = with_later_updates(load(CASE, ["horizon_s=1.0"]))
    assert text == (
        "an update may arrive at a tick of the controller, or up to 0.2 ms before: a live run may use it at "
        "this tick or at the next one, here it is the next one (delay_s = 0.025000001)"
    )
    later = load(CASE, ["horizon_s=1.0", LATER])
    same, nothing = with_later_updates(later)
    assert (same, nothing) == (later, "")
    runs = [simulate(resolve(each))[PLANT_STEP]["u"] for each in (scenario, later)]
    np.testing.assert_array_equal(*runs)
    early = simulate(resolve(load(CASE, ["horizon_s=1.0"])))[PLANT_STEP]["u"]
    assert not np.array_equal(early, runs[0])
