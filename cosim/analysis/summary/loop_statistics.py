"""Statistics of a loop's processes and messages, from its record.

* :func:`lateness` and :func:`latency`: wall times of the processes of a live run.
* Losses: of updates in the network, of datagrams elsewhere (:func:`unintended_losses`), of rows of
  the record (:func:`missing_rows`).
* :func:`reported_violations` of the processes, and the :func:`watchdog_actions` of the plant.
"""

import math
from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.quantiles import QuantileSketch
from cosim.analysis.summary.summary_model import (
    FlowPart,
    LatencyPart,
    LatenessPart,
    ViolationPart,
    WatchdogPart,
)
from cosim.record.run_events import ActuationTimes, PacketOutcome, changes_of, packet_outcomes
from cosim.record.run_record import RunRecord
from netem.core.clock import NEVER_NS, NS_PER_S
from netem.core.packet_rows import Fate, effective
from netem.guarantee.loss_guarantee import LongestBurst
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    STEP_TABLES,
)
from noack.protocol.roles import ENDS, LOOP_ROLES
from noack.protocol.wire_format import Flow, Rejection
from noack.runtime.end_reasons import HORIZON
from plant_server.plant import too_old


def lateness_parts(record: RunRecord, role: str) -> Iterator[NDArray[np.float64]]:
    """Yield the wall time between a process's actions and their nominal times in µs, in order.

    The nominal time is the deadline for plant and controller, the time of the measurement for the
    sensor, and the arrival of the datagram at its socket for the network. A simulated network has
    no socket; its rows have ``now_ns`` there, and are left out.
    """
    for rows in record.batches(STEP_TABLES[role], ("now_ns", "t_ns")):
        late_ns = rows["now_ns"] - rows["t_ns"]
        known = late_ns[late_ns != 0] if role == "netem" else late_ns
        yield np.asarray(known / (1e3 * record.scenario.speed))


def lateness_us(record: RunRecord, role: str) -> NDArray[np.float64]:
    """Return the lateness of all actions of a process, (k,)."""
    return np.concatenate([np.zeros(0), *lateness_parts(record, role)])


def lateness(record: RunRecord, role: str) -> LatenessPart:
    """Return quantiles of a process's lateness, and its number of steps late by over a period."""
    timing = record.scenario.timing
    period_ns = {
        "plant": timing.plant_period_ns,
        "sensor": timing.measurement_period_ns,
        "controller": timing.controller_period_ns,
        "netem": timing.plant_period_ns,
    }[role]
    sketch, late_steps = QuantileSketch(), 0
    for late_us in lateness_parts(record, role):
        sketch.add(late_us)
        late_steps += int((late_us * 1e3 * record.scenario.speed > period_ns).sum())
    return LatenessPart(**_quantiles(sketch), steps=sketch.count, late_steps=late_steps)


def latency_us(record: RunRecord) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the wall time from the sensor's event to the controller's update, one way.

    Returns:
        Event times in ns (d,) and latencies in µs (d,), of the delivered updates.
    """
    events = record.events()
    deliveries = record.columns(CONTROLLER_DELIVERY, "sequence", "now_ns")
    _, at_sensor, at_controller = np.intersect1d(events["event"], deliveries["sequence"], return_indices=True)
    passed_ns = deliveries["now_ns"][at_controller] - events["now_ns"][at_sensor]
    return events["t_ns"][at_sensor], passed_ns / (1e3 * record.scenario.speed)


def latency(record: RunRecord) -> LatencyPart:
    """Return quantiles of the latency."""
    _, passed_us = latency_us(record)
    sketch = QuantileSketch()
    sketch.add(passed_us)
    return LatencyPart(**_quantiles(sketch), updates=len(passed_us))


_SHARES = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}


def _quantiles(sketch: QuantileSketch) -> dict[str, float | None]:
    return dict(zip(_SHARES, sketch.quantiles(*_SHARES.values()), strict=True))


_ARRIVES_AFTER_END_S = 0.1
"""Datagrams due up to this time after the horizon, in wall time, must have arrived."""
_RECEIVERS = {"measurement": "sensor", "actuation": "plant"}
"""The receivers of hops that are not named by theirs."""
_VIOLATION = "violation"
"""Level of a notice: a process detected that an assumption was violated."""
_DROPOUTS = LongestBurst(0).name


def drops_by_cause(outcomes: PacketOutcome) -> dict[str, int]:
    """Return the number of lost updates by cause, without causes of no losses."""
    fates = outcomes.fate
    counts = Counter(fates.tolist())
    causes = {fate.name.lower(): counts[fate] for fate in Fate if not fate.effective}
    causes["delivered_out_of_order"] = int((effective(fates) & outcomes.lost).sum())
    return {cause: n for cause, n in causes.items() if n}


_SENT_RECEIVED = {
    Flow.ACKNOWLEDGEMENT: (CONTROLLER_DELIVERY, SENSOR_ACKNOWLEDGEMENT),
    Flow.ACTUATION: (CONTROLLER_STEP, PLANT_ACTUATION),
}
"""The tables with one row for each message sent, and for each message received."""


def flow_outcome(record: RunRecord, flow: Flow) -> FlowPart | None:
    """Return the outcome of a flow from the controller; None if it does not cross the network."""
    if flow not in record.scenario.network.flows:
        return None
    outcomes, (sent, received) = packet_outcomes(record, flow), _SENT_RECEIVED[flow]
    return FlowPart(
        sent=record.count(sent),
        lost=int(outcomes.lost.sum()),
        longest_loss_burst=outcomes.longest_loss_burst(),
        received=record.count(received),
    )


def unintended_losses(record: RunRecord) -> dict[str, int]:
    """Return the number of datagrams lost without a decision of the emulator, by hop.

    The processes receive for at least 150 ms of wall time beyond the horizon. A datagram that was
    to leave the emulator less than 50 ms before this, or later, is not lost: its receiver may have
    ended. A datagram that its receiver rejected because an entry is not finite has arrived. One whose
    receiver died or stopped responding is lost, and so is one that an emulator held which did.
    """
    last_ns = record.scenario.timing.horizon_ns + _arrives_after_ns(record)
    outcomes, events = packet_outcomes(record), record.events()
    received = record.columns(CONTROLLER_DELIVERY, "sequence")["sequence"]
    every = record.scenario.plant.measure_every
    measured, actuated = _Unmatched(), _Unmatched()
    tables = (PLANT_STEP, SENSOR_MEASUREMENT, CONTROLLER_STEP, PLANT_ACTUATION)
    for part in record.slices(*tables, columns=("sequence", "t_ns")):
        steps, ticks = part[PLANT_STEP], part[CONTROLLER_STEP]
        steps = steps.compress(steps["sequence"] % every == 0)
        measured.take(steps["sequence"] // every, steps["t_ns"], part[SENSOR_MEASUREMENT]["sequence"])
        actuated.take(ticks["sequence"], ticks["t_ns"], part[PLANT_ACTUATION]["sequence"])
    # An update that the controller has may be missing from the record of an emulator that died.
    in_netem = np.union1d(outcomes.sequence, received)
    hops = {
        "measurement": measured,
        "update to netem": _Unmatched().take(events["event"], events["t_ns"], in_netem),
        "update to controller": _Unmatched().take(*_forwarded_until(record, outcomes, last_ns), received),
        "actuation": actuated,
    }
    for flow in record.scenario.network.flows[1:]:
        name, answers = flow.name.lower(), packet_outcomes(record, flow)
        sent, arrived = (record.columns(table, "sequence", "now_ns") for table in _SENT_RECEIVED[flow])
        hops.pop(name, None)
        in_netem = np.union1d(answers.sequence, arrived["sequence"])
        hops[f"{name} to netem"] = _Unmatched().take(sent["sequence"], sent["now_ns"], in_netem)
        hops[f"{name} to {ENDS[flow].receiver}"] = _Unmatched().take(
            *_forwarded_until(record, answers, last_ns), arrived["sequence"]
        )
    counts = {hop: unmatched.count(_arrives_ns(record, _receiver(hop))) for hop, unmatched in hops.items()}
    return {hop: max(count - _count_not_finite(record, hop), 0) for hop, count in counts.items()}


def _receiver(hop: str) -> str:
    """Return the process that receives the datagrams of a hop."""
    return _RECEIVERS.get(hop, hop.rpartition(" ")[2])


def _arrives_after_ns(record: RunRecord) -> float:
    return _ARRIVES_AFTER_END_S * record.scenario.speed * NS_PER_S


def _arrives_ns(record: RunRecord, receiver: str) -> float:
    """Return until when what is sent to a process must arrive; later, it may be in flight at the end.

    Infinite: everything, as the process received beyond the horizon; or it died or stopped responding
    while others went on, and nothing that has not arrived ever will.
    """
    if (report := record.reports.get(receiver)) is not None:
        if report.get("ended") == HORIZON:
            return math.inf
        end_ns = report.get("reached_ns")
        return -math.inf if end_ns is None else end_ns - _arrives_after_ns(record)
    if any(role in record.reports for role in LOOP_ROLES):
        return math.inf
    return _end_ns(record) - _arrives_after_ns(record)  # all processes were killed at once


def _end_ns(record: RunRecord) -> int:
    """Return the latest time that a process reached, as it reported or as its rows tell."""
    recorded_ns = (record.last_ns(table) or 0 for table in STEP_TABLES.values())
    reported_ns = (report.get("reached_ns") or 0 for report in record.reports.values())
    return max(*recorded_ns, *reported_ns)


def _count_not_finite(record: RunRecord, hop: str) -> int:
    """Return the number of datagrams that a hop's receiver rejected because an entry is not finite."""
    channel = record.reports.get(_receiver(hop), {}).get("channel") or {}
    return int((channel.get("rejected") or {}).get(Rejection.NOT_FINITE, 0))


def _forwarded_until(
    record: RunRecord, outcomes: PacketOutcome, last_ns: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the numbers of the datagrams that were to be forwarded until then, and when."""
    passes = outcomes.forwarded
    if "netem" not in record.reports:  # what it still held is lost
        passes, last_ns = ~outcomes.lost, min(last_ns, _end_ns(record))
    passes = passes & (outcomes.due_ns <= last_ns)
    return outcomes.sequence[passes], outcomes.due_ns[passes]


class _Unmatched:
    """Finds the sent numbers that were not received, part by part; both ascend."""

    def __init__(self) -> None:
        self._sent, self._sent_ns = np.zeros((2, 0), np.int64)
        self._newest = -1

    def take(
        self, sent: NDArray[np.int64], sent_ns: NDArray[np.int64], arrived: NDArray[np.int64]
    ) -> "_Unmatched":
        """Add the next numbers; one is received in the same part as it is sent, or later."""
        self._newest = max(self._newest, int(arrived.max(initial=-1)))
        sent, sent_ns = np.concatenate([self._sent, sent]), np.concatenate([self._sent_ns, sent_ns])
        if np.array_equal(sent[: len(arrived)], arrived):
            missing: NDArray[np.bool_] | slice = slice(len(arrived), None)
        else:
            missing = ~np.isin(sent, arrived)
        self._sent, self._sent_ns = sent[missing], sent_ns[missing]
        return self

    def count(self, arrives_ns: float) -> int:
        """Return how many were lost: those before one that arrived, and those sent by ``arrives_ns``."""
        return int(((self._sent_ns <= arrives_ns) | (self._sent <= self._newest)).sum())


def missing_rows(record: RunRecord) -> Counter[str]:
    """Return the number of rows that a process wrote and the record does not contain, by table.

    For a process that died without a report: by process, from the gaps in its input numbers. Of one on
    another host, which may have gone on, at least the steps up to the time that the others reached.
    """
    missing: Counter[str] = Counter()
    for role in LOOP_ROLES:
        if role not in record.reports:
            missing[role] += record.rows_of(role).missing_inputs
            if record.clocks:
                missing[STEP_TABLES[role]] += _steps_without(record, role)
            continue
        for table, count in record.row_counts(role).items():
            missing[table] += record.reports[role]["rows"][table] - count
    return missing


def _steps_without(record: RunRecord, role: str) -> int:
    """Return how many steps of a process are not in the record, up to the time that others reached.

    Of the network, whose datagrams have no period, 0.
    """
    timing = record.scenario.timing
    period = {
        "plant": timing.plant_period,
        "sensor": timing.measurement_period,
        "controller": timing.controller_period,
    }.get(role)
    reached_ns = max((report.get("reached_ns") or 0 for report in record.reports.values()), default=0)
    newest_ns = record.last_ns(STEP_TABLES[role]) or 0
    missing_ns = max(min(reached_ns, timing.horizon_ns) - newest_ns, 0)
    # Times of steps are rounded: the difference of two may be 1 ns too short.
    return 0 if period is None else (missing_ns + (not period.is_whole)) // period.exact


def reported_violations(record: RunRecord) -> list[ViolationPart]:
    """Return the violations that the processes reported, and a loss burst at the end of the run.

    The burst at the end is computed here, because no process can detect it.
    """
    violations = [
        ViolationPart(
            t_s=notice["t_ns"] * 1e-9,
            process=notice["process"],
            cause=_cause(notice["text"]),
            what=notice["text"],
        )
        for notice in record.notices
        if notice["level"] == _VIOLATION
    ]
    outcomes = packet_outcomes(record)
    delivered = np.flatnonzero(~outcomes.lost)
    first = int(delivered[-1]) + 1 if len(delivered) else 0
    mansd = _largest_mansd(record, int(outcomes.event_ns[first - 1]) if first else 0)
    dropped = len(outcomes.lost) - first
    if dropped > mansd:
        last = "the last update was lost" if dropped == 1 else f"the last {dropped} updates were lost"
        text = f"MANSD violated: {last}, at most {mansd} assumed"
        at_s = float(outcomes.event_ns[first + mansd]) * 1e-9
        violations.append(ViolationPart(t_s=at_s, process="netem", cause=_DROPOUTS, what=text))
    return violations


def _cause(text: str) -> str:
    """Return the cause of a violation from a process's message."""
    if "a change" in text:
        return "change"
    rule, violated, _ = text.partition(" violated: ")
    return rule if violated and rule != "MANSD" else _DROPOUTS


def _largest_mansd(record: RunRecord, since_ns: int) -> int:
    """The largest ``mansd`` in force at any time from ``since_ns`` on."""
    changes = changes_of(record)
    caps = [record.scenario.network.mansd, *(change.scenario.network.mansd for change in changes)]
    ends_ns = [*(change.everywhere_ns for change in changes), NEVER_NS]
    return max(cap for cap, end_ns in zip(caps, ends_ns, strict=True) if end_ns > since_ns)


def watchdog_actions(record: RunRecord) -> WatchdogPart:
    """Return the watchdog's actions (the newest actuation was too old) from the recorded steps."""
    timing = record.scenario.timing
    names = ("now_ns", "sequence", "t_ns", "actuation")
    actuations = ActuationTimes()
    trips, steps_old, first_s, was_old = 0, 0, None, False
    for part in record.slices(PLANT_STEP, PLANT_ACTUATION, columns=names):
        steps = part[PLANT_STEP]
        actuations.add(part[PLANT_ACTUATION])
        newest_ns, is_known = actuations.of_newest(steps["actuation"])
        old = is_known & too_old(steps["t_ns"], newest_ns, timing.actuation_timeout_ns)
        begun = np.flatnonzero(old & ~np.append(was_old, old[:-1])[: len(old)])
        if len(begun) and first_s is None:
            first_s = float(steps["t_ns"][begun[0]]) * 1e-9
        trips, steps_old = trips + len(begun), steps_old + int(old.sum())
        was_old = bool(old[-1]) if len(old) else was_old
    return WatchdogPart(
        policy=record.scenario.plant.watchdog.policy,
        timeout_s=timing.actuation_timeout_ns * 1e-9,
        trips=trips,
        first_s=first_s,
        total_s=steps_old * timing.plant_period_ns * 1e-9,
    )
