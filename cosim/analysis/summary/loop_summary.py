"""The summary of a loop, computed from its record."""

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, SupportsFloat, TypedDict

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.loop_statistics import (
    drops_by_cause,
    flow_outcome,
    latency,
    lateness,
    missing_rows,
    reported_violations,
    unintended_losses,
    watchdog_actions,
)
from cosim.analysis.summary.output_statistics import output_parts
from cosim.analysis.summary.signal_statistics import disturbances, signal_statistics
from cosim.analysis.summary.summary_model import ChangePart, ExitPart, LoopSummary
from cosim.record.divergence import Divergence, divergence
from cosim.record.run_events import changes_of, packet_outcomes
from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from netem.core.errors import ExitStatus
from netem.core.packet_rows import NETEM_PACKET, Fate, effective
from netem.impairments.target_loss import expected_loss
from noack.core.linear_systems import Vector
from noack.protocol.record_tables import CONTROLLER_DELIVERY, PLANT_STEP, UPDATES
from noack.protocol.roles import FAILED, LOOP_ROLES
from noack.protocol.wire_format import Flow
from noack.scenario.runtime_parameters import text_of
from noack.scenario.uneven_periods import uneven_periods


@np.errstate(all="ignore")  # a diverging run overflows and has a summary all the same
def summarise_loop(
    record: RunRecord,
    exit_status: int,
    reason: str,
    phase_ns: int = 0,
) -> LoopSummary:
    """Return the summary of a loop, without the results of replay, ideal loop and claims.

    ``exit_status`` and ``reason`` are those of the run; the loop may have failed nevertheless.
    """
    scenario, live = record.scenario, record.kind == "live"
    missing, lost, diverged = missing_rows(record), unintended_losses(record), _divergence(record)
    if exit_status == ExitStatus.OK and (why := _why_failed(record, missing, diverged)):
        exit_status, reason = ExitStatus.FAILED, why
    signals = signal_statistics(record)
    return LoopSummary(
        name=scenario.name,
        number=record.number,
        phase_s=phase_ns / NS_PER_S,
        mode=scenario.mode,
        reached_s=_seconds(record.last_ns(PLANT_STEP)) or 0.0,
        **_transmissions(record),
        link_share=None,  # of the network's bytes, which the record of the loop does not have
        acknowledgements=flow_outcome(record, Flow.ACKNOWLEDGEMENT),
        actuations=flow_outcome(record, Flow.ACTUATION),
        **signals.for_summary(),
        outputs=output_parts(record),
        violations=reported_violations(record),
        uneven_periods=uneven_periods(scenario),
        changes=change_parts(record),
        missing_samples=sum(missing.values()),
        missing_by_table={table: n for table, n in missing.items() if n},
        unintended_losses=sum(lost.values()),
        unintended_losses_by_leg={hop: n for hop, n in lost.items() if n},
        rejected_datagrams={
            role: rejected
            for role, report in record.reports.items()
            if (rejected := _rejected(report["channel"]))
        },
        lateness_us={role: lateness(record, role) for role in LOOP_ROLES if live},
        latency_us=latency(record) if live else None,
        realtime={role: report.get("realtime") or {} for role, report in record.reports.items() if live},
        watchdog=watchdog_actions(record),
        estimation=signals.estimation(),
        disturbances=disturbances(record),
        diverged_at_s=None if diverged is None else diverged.at_s,
        exit=ExitPart(status=int(exit_status), reason=reason),
    )


class _Transmissions(TypedDict):
    """The fields of a loop's summary about its updates."""

    events: int
    deliveries: int
    drops: int
    loss_expected: float | None
    drops_by_cause: dict[str, int]
    forced_deliveries: int
    longest_loss_burst: int
    delay_mean_s: float | None
    delay_max_s: float | None
    loss_bursts: dict[str, int]
    inter_event_min_s: float | None
    inter_event_median_s: float | None
    inter_delivery_median_s: float | None


def _transmissions(record: RunRecord) -> _Transmissions:
    """Counts and intervals of transmissions."""
    events, outcomes = record.events(), packet_outcomes(record)
    deliveries = record.columns(CONTROLLER_DELIVERY, "t_ns", "dropouts")
    intervals_s = np.diff(events["t_ns"]) * 1e-9
    longest = int(deliveries["dropouts"].max(initial=0))
    bursts, delays_s = outcomes.loss_bursts().tolist(), _delays_s(record)
    return {
        "events": len(events),
        "deliveries": len(deliveries),
        "drops": int(outcomes.lost.sum()),
        "loss_expected": _expected_loss(record),
        "drops_by_cause": drops_by_cause(outcomes),
        "forced_deliveries": int((outcomes.fate == Fate.FORCED).sum()),
        "longest_loss_burst": max([*bursts, longest]),
        "delay_mean_s": _or_none(np.mean, delays_s),
        "delay_max_s": _or_none(np.max, delays_s),
        "loss_bursts": {str(n): count for n, count in sorted(Counter(bursts).items())},
        "inter_event_min_s": _or_none(np.min, intervals_s),
        "inter_event_median_s": _or_none(np.median, intervals_s),
        "inter_delivery_median_s": _or_none(np.median, np.diff(deliveries["t_ns"]) * 1e-9),
    }


def _expected_loss(record: RunRecord) -> float | None:
    """Return the predicted loss rate; None if it is not that of all losses of the whole run."""
    if changes_of(record):
        return None
    expected = expected_loss(record.scenario.network.link)
    return None if expected.note else expected.rate


def _delays_s(record: RunRecord) -> Vector:
    """The times of the effectively delivered updates in the network."""
    packets = record.columns(
        NETEM_PACKET,
        "sequence",
        "now_ns",
        "release_ns",
        "flow",
        "fate",
        where=lambda rows: (rows["flow"] == UPDATES) & effective(rows["fate"]),
    )
    packets = record.with_departures(packets)
    return np.asarray((packets["release_ns"] - packets["now_ns"]) / NS_PER_S)


def _rejected(channel: Mapping[str, Any]) -> dict[str, int]:
    """The datagrams that a process rejected, by reason, on all its sockets."""
    both = (channel, channel.get("acknowledgements") or {})
    return dict(sum((Counter(sockets.get("rejected") or {}) for sockets in both), Counter()))


def _why_failed(record: RunRecord, missing: Mapping[str, int], diverged: Divergence | None) -> str | None:
    """Return why a run that ended at its horizon failed; None if it did not fail."""
    if diverged is not None:
        return diverged.text
    for notice in record.notices:
        if notice["level"] == FAILED:
            at_s = notice["t_ns"] * 1e-9
            return f"the {notice['process']} failed at {at_s:g} s: {notice['text']}"
    surplus = [f"{-n:,} of {table}" for table, n in missing.items() if n < 0]
    if surplus:
        return f"the record has more rows than the processes reported: {', '.join(surplus)}"
    incomplete = [f"{missing[table]:,} of {table}" for table in record.tables if missing[table] > 0]
    return f"rows are missing from the record: {', '.join(incomplete)}" if incomplete else None


def _divergence(record: RunRecord) -> Divergence | None:
    scenarios = [record.scenario, *(change.scenario for change in changes_of(record))]
    batches = record.batches(PLANT_STEP, ("t_ns", "x"))
    parts = ((steps["t_ns"] * 1e-9, steps["x"]) for steps in batches)
    diverged = divergence(parts, record.count(PLANT_STEP), scenarios)
    for notice in record.notices:
        if diverged is not None and notice["level"] == FAILED:
            text = f"the plant failed at {diverged.at_s:g} s: {notice['text']}"
            return diverged._replace(text=text)
    return diverged


def change_parts(record: RunRecord) -> list[ChangePart]:
    """Return the changes of settings during the run."""
    return [
        ChangePart(
            number=change.change.number,
            t_s=change.change.t_ns / NS_PER_S,
            settings=dict(change.change.settings),
            what=text_of(change.change.settings),
            in_force_from_s={role: ns / NS_PER_S for role, ns in change.since_ns.items()},
        )
        for change in changes_of(record)
    ]


def _seconds(t_ns: int | None) -> float | None:
    return None if t_ns is None else float(t_ns) * 1e-9


def _or_none(
    statistic: Callable[[NDArray[np.float64]], SupportsFloat], values: NDArray[np.float64]
) -> float | None:
    return float(statistic(values)) if len(values) else None
