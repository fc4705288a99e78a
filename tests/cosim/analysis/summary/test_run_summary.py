"""Datagrams inside the network, loops over time, and the loop that is shown in detail."""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.summary.loops_over_time import INTERVALS, intervals_of, loop_over_time
from cosim.analysis.summary.run_summary import counts_inside, in_flight, worst_loop
from cosim.analysis.summary.summary_model import LoopSummary
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import NETEM_PACKET, network_tables
from tests.helpers.shipped import resolved
from tests.helpers.summaries import claim, summary_of

S = 10**9


def test_counts_of_two_overlapping_datagrams_have_a_closed_form() -> None:
    """One is inside from 0 s to 20 s, the other from 10 s to 30 s."""
    begin_ns, end_ns = np.array([0, 10]) * S, np.array([20, 30]) * S
    edges_ns = np.array([0.0, 5.0, 15.0, 25.0, 40.0]) * S
    means, largest = counts_inside(begin_ns, end_ns, edges_ns)
    np.testing.assert_allclose(means, [1, 1.5, 1.5, 5 / 15], rtol=1e-12)
    assert largest.tolist() == [1, 2, 2, 1]


def test_the_number_in_flight_is_that_of_overlapping_delays() -> None:
    """Two datagrams overlap from 10 to 20 s; a third did not wait, a fourth was lost."""
    packets = np.zeros(4, network_tables()[NETEM_PACKET])
    packets["copy_ns"] = -1
    packets["now_ns"] = np.array([0, 10, 50, 60]) * S
    packets["release_ns"] = np.array([20 * S, 30 * S, 50 * S, -1])
    counts = in_flight(packets, 100 * S, 100 * S)
    assert (counts.mean, counts.max, counts.width_s) == (pytest.approx(0.4), 2, 0.5)
    assert counts.max_by_interval[:60] == [1] * 20 + [2] * 20 + [1] * 20
    assert not any(counts.max_by_interval[61:])
    assert counts.mean_by_interval[20:40] == [2.0] * 20
    assert in_flight(packets, 100 * S, 40 * S).mean == pytest.approx(1.0)  # stopped


def test_a_loop_over_time_has_the_largest_state_of_each_interval() -> None:
    record, phase_ns = simulate(resolved("double_integrator", "horizon_s=1")), S // 4
    rows, horizon_ns = record["sensor_measurement"], record.scenario.timing.horizon_ns
    intervals = intervals_of(rows["t_ns"] + phase_ns, horizon_ns)
    norms = np.linalg.norm(rows["x"], axis=1)
    expected = [norms[intervals == i].max() if (intervals == i).any() else np.nan for i in range(INTERVALS)]
    np.testing.assert_allclose(loop_over_time(record, phase_ns).states, expected, rtol=1e-12)


@pytest.fixture(scope="module")
def loop() -> LoopSummary:
    (summary,) = summary_of(simulate(resolved("double_integrator", "horizon_s=0.2"))).loops
    return summary


def bound(formula: str, ratio: float, source: str = "certificate") -> dict[str, Any]:
    return claim("held", bound=formula, ratio=ratio, source=source)


FAILED = {"exit": {"status": 1, "reason": "diverged"}}


@pytest.mark.parametrize(
    ("loops", "number", "reason"),
    [
        ([{}, FAILED, {"claims": [bound("‖x‖ ≤ 1", 0.9)]}], 1, "diverged"),
        ([{"claims": [bound("‖x‖ ≤ 1", 0.5)]}, {"claims": [bound("‖W e_c‖ ≤ 1", 0.6)]}], 1, ": 60 %"),
        # Other bounds do not count: those of times, and those that are computed from the run.
        ([{"claims": [bound("‖e_c‖ ≤ 1", 0.5)]}, {"claims": [bound("t_(i+1) − t_i ≥ 1 s", 0.9)]}], 0, "50 %"),
        ([{"claims": [bound("‖e_c‖ ≤ 1", 1.0, "(I1)")], "sup_e_c_norm": 1.0}, {"sup_e_c_norm": 2.0}], 1,
         "largest ‖e_c‖, 2; no loop has a certified bound"),
        ([{"sup_e_c_norm": None}, {"sup_e_c_norm": 0.0}], 1, "largest ‖e_c‖, 0"),
    ],
)  # fmt: skip
def test_the_worst_loop_failed_or_came_nearest_to_a_bound(
    loop: LoopSummary, loops: list[dict[str, Any]], number: int, reason: str
) -> None:
    content = loop.model_dump(mode="json") | {"claims": []}
    summaries = [
        LoopSummary.model_validate(content | {"number": i} | changes) for i, changes in enumerate(loops)
    ]
    worst = worst_loop(summaries)
    assert worst.number == number
    assert reason in worst.why
