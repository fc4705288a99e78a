"""Datagrams inside the network, loops over time, and the loop that is shown in detail."""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.loops_over_time import INTERVALS, intervals_of, loop_over_time
from cosim.analysis.summary.run_summary import in_flight, worst_loop
from cosim.analysis.summary.summary_model import LoopSummary
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from netem.core.packet_rows import NETEM_PACKET, NETEM_RELEASE
from noack.protocol.record_tables import CONTROLLER_DELIVERY, network_tables
from tests.cosim.record.changed_records import changed
from tests.helpers.shipped import resolved
from tests.helpers.summaries import claim, summary_of

S = 10**9


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


def bound(quantity: str, ratio: float, kind: str = "certificate") -> dict[str, Any]:
    return claim("held", quantity=quantity, ratio=ratio, kind=kind)


FAILED = {"exit": {"status": 1, "reason": "diverged"}}


@pytest.mark.parametrize(
    ("loops", "number", "reason"),
    [
        ([{}, FAILED, {"claims": [bound("x", 0.9)]}], 1, "diverged"),
        ([{"claims": [bound("x", 0.5)]}, {"claims": [bound("e_c", 0.6)]}], 1, ": 60 %"),
        # Other bounds do not count: those of times, and those that are computed from the run.
        ([{"claims": [bound("e_c", 0.5)]}, {"claims": [bound("inter_event", 0.9)]}], 0, "50 %"),
        ([{"claims": [bound("e_c", 1.0, "identity")], "sup_e_c_norm": 1.0}, {"sup_e_c_norm": 2.0}], 1,
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


# --- lost, but by no decision of the emulator -----------------------------------------------------


SENDING = ("horizon_s=3", "network.mansd=0", 'trigger={policy="periodic", period_s=0.1}')
ENDED_EARLY = {"ended": "netem stopped responding", "reached_ns": 3 * S}


def stopped_network(stopped_s: float, **reports: Any) -> RunRecord:
    """A run of 3 s whose emulator did nothing from a time on."""
    record = simulate(resolved("double_integrator", *SENDING))
    begins_ns = int(stopped_s * S)
    rows = {
        table: record[table][record[table]["now_ns"] < begins_ns]
        for table in (NETEM_PACKET, NETEM_RELEASE, CONTROLLER_DELIVERY)
    }
    left = {role: report for role, report in record.reports.items() if role != "netem"}
    return changed(record, rows, reports=left | reports)


@pytest.mark.parametrize("others", ["went on to the end", "were ended"])
def test_updates_to_a_network_that_was_stopped_are_lost(others: str) -> None:
    record = stopped_network(1.0)
    if others == "were ended":
        reports = {role: report | ENDED_EARLY for role, report in record.reports.items()}
        record = changed(record, reports=reports)
    summary = summarise_loop(record, 1, "netem stopped responding")
    unaccounted = summary.events - summary.deliveries - summary.drops
    assert unaccounted > 3
    assert summary.unintended_losses_by_leg["update to netem"] == unaccounted


def test_updates_that_a_stopped_network_held_are_lost() -> None:
    """It forwarded none that it had delayed by 0.2 s, and did not tell that it had ended."""
    delay = 'network.impairments=[{kind="delay", delay_s=0.2}]'
    record = simulate(resolved("double_integrator", *SENDING, delay))
    packets = record[NETEM_PACKET]
    packets = packets[packets["now_ns"] < S]
    rows = {
        NETEM_PACKET: packets,
        NETEM_RELEASE: record[NETEM_RELEASE][:0],
        CONTROLLER_DELIVERY: record[CONTROLLER_DELIVERY][:0],
    }
    reports = {role: report for role, report in record.reports.items() if role != "netem"}
    summary = summarise_loop(changed(record, rows, reports=reports), 1, "netem died")
    by_hop = summary.unintended_losses_by_leg
    assert by_hop["update to controller"] == len(packets) > 3
    assert sum(by_hop.values()) == summary.events


def test_what_is_in_flight_when_all_are_stopped_is_not_lost() -> None:
    """But an update that was sent 0.1 s before the end, or earlier, is not in flight."""
    record = stopped_network(2.95)
    reports = {role: report | ENDED_EARLY for role, report in record.reports.items()}
    sent_ns = record.events()["t_ns"][record.count(CONTROLLER_DELIVERY) :]
    assert len(sent_ns)
    for reached_ns, lost in ((sent_ns[0] + S // 20, 0), (sent_ns[0] + S // 10, 1)):
        of_netem = {"reached_ns": int(reached_ns), "rows": record.row_counts("netem")}
        reports["netem"] = reports["plant"] | of_netem
        summary = summarise_loop(changed(record, reports=reports), 130, "stopped by the user")
        assert summary.unintended_losses_by_leg.get("update to netem", 0) == lost
