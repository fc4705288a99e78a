"""Documents without motions against simulated runs, and the margin against known limits."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cosim.simulation.virtual_time import simulate
from netem.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from noack.proof.period_document import PeriodDocument
from noack.proof.period_graph import PeriodGraph, float_rows
from noack.scenario.scenario import Scenario
from noack.theory.witnesses.loss_margin import LossMargin
from tests.helpers.approved import compare_lines, lines_of_error
from tests.helpers.shipped import resolved

PERIODIC = 'trigger={policy="periodic", period_s=0.0997}'
DWELL = '{policy="dwell", interval_s=0.11, rule={policy="absolute", delta=1}}'
DEADLINE = f'{{policy="deadline", interval_s=0.3, rule={DWELL}}}'
HOLDS = 'controller.timeout_input="hold"'
DELAYED = 'network.impairments=[{kind="delay", delay_s=0.0333}]'


def at(plant_hz: float, controller_hz: float, periods: int) -> tuple[str, ...]:
    """Rates, and an update after so many periods of the plant."""
    trigger = f'trigger={{policy="periodic", period_s={periods / plant_hz!r}}}'
    return f"plant.rate_hz={plant_hz!r}", f"controller.rate_hz={controller_hz!r}", trigger


def timeout(seconds: float) -> tuple[str, ...]:
    """At ticks at the times of steps."""
    return "controller.phase=0", f"controller.update_timeout_s={seconds!r}"


def late(seconds: float) -> str:
    return f'network.impairments=[{{kind="delay", delay_s={seconds!r}}}]'


def scenario(name: str, *settings: str) -> Scenario:
    return resolved(name, PERIODIC, "network.mansd=20", *settings)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("double_integrator", ()),
        ("double_integrator", ("mode=zoh",)),
        ("double_integrator", (DELAYED,)),
        ("double_integrator", ("controller.rate_hz=10", DELAYED.replace("333", "99"))),
        ("double_integrator", ("controller.rate_hz=40", "controller.phase=0.3")),
        ("double_integrator", ("plant.measure_every=7", "controller.phase=0")),
        ("lane_following", ("controller.phase=0", "controller.rate_hz=125", DELAYED)),
        ("double_integrator", ("mode=zoh", "controller.update_timeout_s=0.1")),
        ("double_integrator", ("controller.update_timeout_s=0.25", HOLDS)),
        ("double_integrator", ("controller.update_timeout_s=0.21", HOLDS, DELAYED)),
        ("lane_following", ("controller.update_timeout_s=0.11", "controller.rate_hz=125", DELAYED)),
        (
            "lane_following",
            ("mode=zoh", "controller.update_timeout_s=0.133", "controller.rate_hz=40", DELAYED),
        ),
        # Periods that are no whole nanoseconds; delays, phases and timeouts of whole steps, and others.
        ("double_integrator", at(30.0, 30.0, 3)),
        ("double_integrator", (*at(60.0, 30.0, 5), "controller.phase=0.5", late(2 / 60))),
        ("double_integrator", (*at(30.0, 60.0, 4), "controller.phase=0", DELAYED)),
        ("lane_following", (*at(90.0, 120.0, 9), "controller.phase=0", late(1 / 30))),
        ("lane_following", (*at(144.0, 48.0, 17), f"controller.update_timeout_s={26 / 144!r}")),
        ("double_integrator", (*at(90.0, 45.0, 5), "controller.phase=0.5")),
        ("double_integrator", (*at(30.0, 30.0, 4), *timeout(8 / 30), late(2 / 30), "horizon_s=20")),
        ("double_integrator", (*at(30.0, 90.0, 4), *timeout(17 / 90), HOLDS)),
        ("double_integrator", (*at(3.0, 30.0, 1), "plant.watchdog.timeout_s=2", "horizon_s=30")),
        # Delays of several periods.
        ("double_integrator", (late(0.2324),)),
        ("double_integrator", ("mode=zoh", late(0.1), at(100.0, 100.0, 5)[2])),
        ("lane_following", ("controller.phase=0", "controller.rate_hz=125", late(0.31))),
        ("lane_following", (*at(90.0, 120.0, 9), "controller.phase=0", late(0.2))),
    ],
)
def test_documents_are_those_of_a_simulated_run(name: str, settings: Sequence[str]) -> None:
    resolved = scenario(name, "horizon_s=6", "certificate.late_periods=0", *settings)
    margin = LossMargin(resolved)
    times, behind = margin.period_loop.times, margin.period_loop.times.behind
    document = PeriodDocument(margin.period_loop, LossGuarantee((LongestBurst(MOST_LOST),)))
    graph, delay_ns = PeriodGraph(document.table), int(margin.delay_ns)
    rng, fates = np.random.default_rng(1), [True]
    while len(fates) < 1000:
        fates += [*[False] * int(rng.integers(0, MOST_LOST + 1)), *[True] * int(rng.integers(1, 3))]
    numbers = iter(range(1000))
    run = simulate(resolved, lambda data, now_ns: delay_ns if fates[next(numbers)] else None)

    steps, tested = run["plant_step"], run["sensor_measurement"]
    sent_ns = tested["t_ns"][tested["event"] >= 0]
    np.testing.assert_allclose(np.diff(sent_ns), margin.seconds(margin.longest) * 1e9, rtol=0, atol=0.99)
    assert len(sent_ns) > 15
    tolerance = 1e-10 if resolved.timing.has_whole_periods else 1e-6  # times are rounded there
    z, place = float_rows(document.table["start"]["columns"])[:, 0], 0
    n, m = margin.period_loop.B.shape
    for k, t_ns in enumerate(sent_ns):
        row = steps[np.searchsorted(steps["t_ns"], t_ns)]
        expected = np.concatenate([row["x"], row["u"]])
        size = max(np.abs(expected).max(), 1e-6)
        np.testing.assert_allclose(z[: n + m], expected, rtol=0, atol=tolerance * size)
        fate = fates[k - behind] if k >= behind else True
        edges = [e for e in graph.edges if e.source == place and document.outcomes[e.name][0] is fate]
        arrivals = times.arrivals(k % times.slots)
        edge = edges[-1] if len(edges) > 1 and arrivals[0] == max(arrivals) else edges[0]
        z, place = edge.map @ z, edge.target


MOST_LOST = 4


def test_the_margin_does_not_depend_on_the_unit_of_the_input() -> None:
    margin = LossMargin(scenario("unstable_pendulum", "mode=zoh", "certificate.late_periods=0"))
    guarantee, loop = LossGuarantee((LongestBurst(3),)), margin.period_loop
    expected = margin.stability(guarantee)
    for unit in (2.0**40, 1e-12):
        margin.period_loop = replace(loop, B=loop.B * unit, K=loop.K / unit)
        stability = margin.stability(guarantee)
        assert stability.pattern == expected.pattern
        assert stability.lower == pytest.approx(expected.lower, rel=1e-8)
        assert stability.upper == pytest.approx(expected.upper, rel=1e-2)


@pytest.mark.parametrize(
    ("gain", "delay_s", "phase", "verdict"),
    [
        (29.89, 0.045, 0.5, "stable"), (29.894, 0.045, 0.5, "destabilised"),
        # Until the tick after the arrival, then until the plant's next step.
        (29.0, 0.047, 0.5, "stable"), (29.0, 0.048, 0.5, "destabilised"),
        (29.0, 0.0457, 0.2, "stable"), (29.0, 0.047, 0.2, "destabilised"),
        (29.0, 0.046, 0.2, "destabilised"),  # at a tick: it acts at this one or at the next one
        pytest.param(29.0, 0.05, 0.0, "destabilised", marks=pytest.mark.deep),
    ],
)  # fmt: skip
def test_a_delay_of_ten_periods_has_the_known_limit(
    gain: float, delay_s: float, phase: float, verdict: str
) -> None:
    """x⁺ = x − kh x ten steps before is stable for k below 2 sin(π / 42) / h = 29.892 per second."""
    settings = (
        "certificate.late_periods=0", "mode=zoh",
        "model={A=[[0.0]], B=[[1.0]], gain=[[%r]]}" % -gain, "network.mansd=0", "horizon_s=6",
        "plant={initial_state=[1.0], rate_hz=200.0}", "controller.rate_hz=200",
        f"controller.phase={phase}", 'trigger={policy="periodic", period_s=0.005}', late(delay_s),
    )  # fmt: skip
    assert LossMargin(scenario("double_integrator", *settings)).stability().verdict == verdict


def test_what_is_not_covered_is_refused_with_the_approved_line() -> None:
    def margin(settings: str) -> object:
        return LossMargin(scenario("double_integrator", *settings.split(" & "))).stability()

    compare_lines(
        Path(__file__).with_name("margin_refusals.txt"),
        lambda settings: lines_of_error(lambda: margin(settings)),
    )
