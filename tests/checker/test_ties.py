"""Updates that arrive at a tick of the controller act at this tick or at the next one, anew each time."""

from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.mean_cost import find_mean_cost
from cosim.simulation.virtual_time import simulate
from netem.core.errors import CallerError
from netem.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from netem.impairments.target_loss import loss_process
from noack.core.linear_systems import Matrix
from noack.proof.period_document import PeriodDocument
from noack.proof.period_graph import PeriodGraph
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP
from noack.scenario.arrival_ties import late_inputs, with_later_updates
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.random_losses.mean_square_growth import growth_without_guarantee
from noack.theory.witnesses.loss_margin import LossMargin

CASE = Path(__file__).parents[1] / "cases" / "drive_tie.toml"
"""A packet every 10 ms arrives 25 ms later, at a tick of the controller, 5 ms after a transmission."""
LATER = 'network.impairments=[{kind="delay", delay_s=0.02508}]'
BEFORE = 'network.impairments=[{kind="delay", delay_s=0.02495}]'
EXPIRES = "controller.update_timeout_s=0.055"
LATENESS = "certificate.late_periods={}"
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
    assert loop.period_loop.times.arrivals(0) == arrivals
    assert bool(loop.ties) == (len(arrivals) > 1)


def test_an_arrival_that_may_be_in_the_next_period_is_refused() -> None:
    with pytest.raises(CallerError, match=r"of a transmission and of a tick; change controller\.phase"):
        margin(*NEAR_THE_NEXT)


WITHIN_A_PERIOD = 'network.impairments=[{kind="delay", delay_s=0.005}]', "controller.update_timeout_s=0.015"
"""At the tick of an arrival that misses it, the update before is as old as the timeout."""
LATER_WITHIN = 'network.impairments=[{kind="delay", delay_s=0.00508}]', WITHIN_A_PERIOD[1]


@pytest.mark.parametrize(
    ("at", "beyond"), [((), (LATER,)), (WITHIN_A_PERIOD, LATER_WITHIN), ((EXPIRES,), (EXPIRES, LATER))]
)
def test_either_outcome_is_that_of_a_loop_without_the_tie(
    at: tuple[str, ...], beyond: tuple[str, ...]
) -> None:
    """A loop whose delay is 0.08 ms more has the same outcomes."""
    tied, later = (maps(margin(*settings, LATENESS.format(2))) for settings in (at, beyond))
    assert {*tied} == {*later}
    for name, M in tied.items():
        np.testing.assert_allclose(M, later[name], atol=1e-12, err_msg=name)


def maps(loop: LossMargin) -> dict[str, Matrix]:
    """Return the map of each edge of a document with three losses."""
    document = PeriodDocument(loop.period_loop, LossGuarantee((LongestBurst(3),)))
    return {edge.name: edge.map for edge in PeriodGraph(document.table).edges}


def test_more_losses_are_not_proven_than_with_both_outcomes() -> None:
    """With early arrivals alone 13 losses are proven, and are false of a live run."""
    loop = margin(LATENESS.format(0))
    assert loop.stability(loop.guarantee.capped(3), 0.03).verdict == "stable"
    assert loop.stability(loop.guarantee.capped(11), 0.03).verdict == "stable"
    assert loop.stability(loop.guarantee.capped(13), 0.03, effort=0.1).verdict == "destabilised"


@pytest.mark.parametrize("late", [0, 1, 3])
def test_inputs_may_act_some_steps_late(late: int) -> None:
    """The tick is 5 ms after a transmission, and its input acts 1 ms after it, or later."""
    found = maps(margin(LATENESS.format(late), "controller.phase=0.25"))
    outcomes = [name for name in found if name.startswith("1 lost, delivered")]
    assert len(outcomes) == (late + 1 if late else 1)
    different = {found[name].round(9).tobytes() for name in outcomes}
    assert len(different) == len(outcomes)


def test_updates_expire_that_are_on_their_way_for_several_periods() -> None:
    """A tick is 2.5 ms after a transmission, and the newest update that has arrived 32.5 ms old, or older."""
    loop = margin(EXPIRES, LATENESS.format(0), "controller.phase=0.25", LATER)
    document = PeriodDocument(loop.period_loop, LossGuarantee((LongestBurst(5),)))
    edges = {edge["name"]: edge["jump"] for edge in document.table["edges"]}
    safe = [name for name, steps in edges.items() if "safe tick" in steps]
    outcomes = (f"{lost} lost, {outcome}" for lost in (3, 4, 5) for outcome in ("delivered", "lost"))
    assert safe == [*outcomes][:-1]
    assert loop.stability(loop.guarantee.capped(3), 0.03).verdict == "stable"


def test_a_simulation_takes_the_later_tick_and_says_so() -> None:
    scenario, text = with_later_updates(load(CASE, ["horizon_s=1.0"]))
    assert text == (
        "an update may arrive at a tick of the controller, or up to 0.2 ms before: a live run may use it at "
        "this tick or at the next one, here it is the next one (delay_s = 0.025001)"
    )
    later = load(CASE, ["horizon_s=1.0", LATER])
    same, nothing = with_later_updates(later)
    assert (same, nothing) == (later, "")
    runs = [simulate(resolve(each))[PLANT_STEP]["u"] for each in (scenario, later)]
    np.testing.assert_array_equal(*runs)
    early = simulate(resolve(load(CASE, ["horizon_s=1.0"])))[PLANT_STEP]["u"]
    assert not np.array_equal(early, runs[0])


AT_ONCE = ("network.impairments=[]", "controller.phase=0.0")
"""Nothing is delayed, and each packet is sent at a tick."""


@pytest.mark.parametrize(
    ("phase", "delay_s"),
    [(0.5, 0.025001), (0.50005, 0.025001), (0.5001, 0.025002), (0.4, 0.025001)],
)
def test_every_loop_of_a_run_takes_the_later_tick(phase: float, delay_s: float) -> None:
    """Also where the delay of all loops, beyond the tick of one, is at the tick of another."""
    second = f'{{name="second", phase=0.3, controller={{phase={phase}}}}}'
    given = load(CASE, [f'loops=[{{name="first", phase=0.0}}, {second}]', "horizon_s=0.3"])
    scenario, text = with_later_updates(given)
    assert "here it is the next one" in text
    assert with_later_updates(scenario) == (scenario, "")
    assert [stage.content()["delay_s"] for stage in scenario.network.impairments] == [delay_s]


def test_an_update_is_at_most_the_live_latency_later_if_ticks_are_nearer_to_each_other() -> None:
    fast = ("controller.rate_hz=20000", "plant.rate_hz=20000", "horizon_s=0.3")
    (delay,) = with_later_updates(load(CASE, [*fast]))[0].network.impairments
    assert 0.02515 < delay.content()["delay_s"] <= 0.0252 + 1e-6


def test_an_update_without_delay_misses_a_tick_at_its_transmission() -> None:
    scenario, _ = with_later_updates(load(CASE, [*AT_ONCE, "horizon_s=0.3"]))
    assert with_later_updates(scenario) == (scenario, "")
    assert [stage.content()["delay_s"] for stage in scenario.network.impairments] == [1e-6]
    early, later = (simulate(resolve(each)) for each in (load(CASE, [*AT_ONCE, "horizon_s=0.3"]), scenario))
    inputs = [run[CONTROLLER_STEP]["u"][:, 0] for run in (early, later)]
    assert inputs[0][0] != 0
    assert inputs[1][0] == 0
    assert inputs[1][1] == inputs[0][0]


def test_delays_that_vary_have_no_ties() -> None:
    for stages in ('{kind="delay", delay_s=0.025, jitter_s=0.001}', '{kind="rate", rate_bps=1000000}'):
        scenario = load(CASE, [f"network.impairments=[{stages}]", "controller.phase=0.0"])
        assert with_later_updates(scenario) == (scenario, "")


@pytest.mark.parametrize("settings", [(), AT_ONCE])
def test_mean_square_growth_and_cost_are_those_of_the_later_tick(settings: tuple[str, ...]) -> None:
    nominal = load(CASE, list(settings))
    later = resolve(with_later_updates(nominal)[0])
    losses = loss_process(later.network.link)
    growths = [growth_without_guarantee(each, losses) for each in (resolve(nominal), later)]
    assert growths[0].per_period == growths[1].per_period
    assert "each update at the later of its ticks" in growths[0].text
    assert "each update at the later of its ticks" not in growths[1].text
    computed = find_mean_cost(later).without_guarantee
    assert computed.growth == pytest.approx(growths[0].per_period, rel=1e-6)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("settings", "is_late"),
    [
        ((), False),
        (("controller.phase=0.49",), True),
        (("controller.phase=0.51",), False),
        (("plant.rate_hz=10000", "plant.measure_every=100", "controller.phase=0.505"), True),
        (("plant.rate_hz=10000", "plant.measure_every=100"), False),
        (('network.actuation={mansd=1, loss={model="lossless"}}', "controller.phase=0.49"), False),
    ],
)
def test_inputs_shortly_before_a_step_of_the_plant_are_named(
    settings: tuple[str, ...], is_late: bool
) -> None:
    assert bool(late_inputs(load(CASE, list(settings)))) == is_late


@pytest.mark.parametrize(("losses", "safe_ms"), [(1, []), (2, [145.0]), (3, [145.0, 155.0])])
def test_updates_expire_after_two_losses(losses: int, safe_ms: list[float]) -> None:
    """The age at a tick is nominal, so a timeout that is equal to it acts, live as well.

    The update of 90 ms misses the tick at 115 ms, acts from that at 125 ms on, and is 55 ms old at 145 ms.
    """
    script = f"network.loss={{model='scripted', lost={list(range(10, 10 + losses))}}}"
    nominal = load(CASE.with_name("drive_timeout.toml"), [script, "horizon_s=0.3"])
    rows = simulate(resolve(with_later_updates(nominal)[0]))[CONTROLLER_STEP]
    times_ms = rows["t_ns"] / 1e6
    is_safe = (rows["u"][:, 0] == 0) & (times_ms > 60)
    assert times_ms[is_safe].tolist() == safe_ms
