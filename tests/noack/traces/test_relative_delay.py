"""Relative delays: the lower envelope against linear programming; drifts and steps of clocks."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from noack.traces.packet_trace import PacketTrace, envelope_slope, packet_trace, relative_delays

PERIOD_NS = 20_000_000


def measured(count: int, drift_ppm: float, step_ns: int = 0) -> PacketTrace:
    """Return a trace of two clocks with this drift and a step at three fifths of it."""
    rng = np.random.default_rng(3)
    sent = np.arange(count) * PERIOD_NS
    delay = 5e6 + rng.exponential(2e6, count) + np.where(rng.random(count) < 0.01, 1e9, 0)
    shift = np.where(np.arange(count) >= 0.6 * count, step_ns, 0)
    received = sent + delay + drift_ppm * 1e-6 * sent + shift - 10**12
    lost = rng.random(count) < 0.1
    return packet_trace(sent, received.astype(np.int64), lost, clocks_differ=True)


@given(st.lists(st.integers(0, 10**6), min_size=3, max_size=40))
def test_the_envelope_is_the_optimum_of_a_linear_program(delays: list[int]) -> None:
    t, y = np.arange(len(delays)) * 10, np.array(delays)
    slope = envelope_slope(t, y)
    points = np.column_stack((t, np.ones(len(t))))
    best = linprog(-points.sum(axis=0), A_ub=points, b_ub=y, bounds=(None, None))
    offset = (y - slope * t).min()
    assert (y - slope * t - offset).sum() == pytest.approx(y.sum() + best.fun, rel=1e-6, abs=1e-3)


@pytest.mark.parametrize("drift_ppm", [-80.0, 0.0, 35.0])
def test_a_drift_is_found_and_removed(drift_ppm: float) -> None:
    trace = relative_delays(measured(3000, drift_ppm))
    (line,) = [line for line in trace.notes if "ppm" in line]
    # 60 s; the envelope's ends lie within 0.1 ms above the smallest delay.
    assert float(line.split()[4]) == pytest.approx(drift_ppm, abs=3)
    delay_ns = trace.delay_ns[~trace.lost]
    assert delay_ns.min() == 0
    reference = measured(3000, 0).delay_ns[~trace.lost]
    assert np.abs(delay_ns - reference).max() < 0.2e6


@pytest.mark.parametrize("step_ns", [-200_000_000, 100_000_000])
def test_a_step_of_a_clock_is_found(step_ns: int) -> None:
    trace = relative_delays(measured(3000, 20, step_ns))
    (line,) = [line for line in trace.notes if "a clock was set" in line]
    assert float(line.split()[5]) == pytest.approx(step_ns / 1e6, abs=2)
    assert 35 < float(line.split(" s: ")[0].split()[-1]) < 37
    assert not any("ppm" in line for line in trace.notes)


def test_an_outage_is_no_step() -> None:
    trace = measured(3000, 0)
    received = trace.received_ns.copy()
    received[1000:1500] = np.where(trace.lost[1000:1500], -1, trace.sent_ns[1500] + 5_000_000)
    changed = PacketTrace(trace.sequence, trace.sent_ns, received)
    assert not any("a clock was set" in line for line in relative_delays(changed).notes)


def test_nothing_received() -> None:
    trace = packet_trace(np.arange(3), np.zeros(3, np.int64), np.ones(3, bool))
    assert relative_delays(trace).lost.all()
