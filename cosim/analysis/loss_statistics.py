"""Losses of a run: updates in the network, datagrams elsewhere, rows of the record."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.observed_conditions import DROPOUTS, AssumptionViolation
from cosim.analysis.summary_model import FlowPart, ViolationPart
from cosim.record.packet_outcomes import PacketOutcome, packet_outcomes
from cosim.record.recorded_changes import NEVER_NS, changes_of
from cosim.record.run_record import RunRecord
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    Fate,
    effective,
)
from noack.protocol.topology import ENDS, LOOP_ROLES
from noack.protocol.wire_format import Flow
from noack.runtime.life_cycle import HORIZON

_ARRIVES_AFTER_END_S = 0.1
VIOLATION = "violation"
"""Level of a notice: a process detected that an assumption was violated."""


def drops_by_cause(outcomes: PacketOutcome) -> dict[str, int]:
    """Return the number of lost updates by cause, without causes of no losses."""
    fates = outcomes.fate
    causes = {one.name.lower(): int((fates == one).sum()) for one in Fate if not one.effective}
    causes["delivered_out_of_order"] = int((effective(fates) & outcomes.lost).sum())
    return {cause: n for cause, n in causes.items() if n}


_SENT_RECEIVED = {
    Flow.ACKNOWLEDGEMENT: (CONTROLLER_DELIVERY, SENSOR_ACKNOWLEDGEMENT),
    Flow.ACTUATION: (CONTROLLER_STEP, PLANT_ACTUATION),
}
"""The tables with one row for each message sent, and for each message received."""


def from_controller(record: RunRecord) -> dict[str, FlowPart]:
    """The outcome of what the controller sends through the network, by its name."""
    found = {}
    for flow in record.scenario.network.flows[1:]:
        outcomes, (sent, received) = packet_outcomes(record, flow), _SENT_RECEIVED[flow]
        found[f"{flow.name.lower()}s"] = FlowPart(
            sent=record.count(sent),
            lost=int(outcomes.lost.sum()),
            longest_loss_burst=outcomes.longest_loss_burst(),
            received=record.count(received),
        )
    return found


def unintended_losses(record: RunRecord) -> dict[str, int]:
    """Return the number of datagrams lost without a decision of the emulator, by hop.

    The processes receive for at least 150 ms of wall time beyond the horizon. A datagram that was
    to leave the emulator less than 50 ms before this, or later, is not lost: its receiver may have
    ended.
    """
    last_ns = record.scenario.timing.horizon_ns + _ARRIVES_AFTER_END_S * record.scenario.speed * 1e9
    outcomes, events = packet_outcomes(record), record.events()["event"]
    received = record.columns(CONTROLLER_DELIVERY, "sequence")["sequence"]
    every = record.scenario.plant.measure_every
    measured, actuated = _Unmatched(), _Unmatched()
    tables = (PLANT_STEP, SENSOR_MEASUREMENT, CONTROLLER_STEP, PLANT_ACTUATION)
    for part in record.slices(*tables, columns=("sequence",)):
        sent = part[PLANT_STEP]["sequence"]
        measured.take(sent[sent % every == 0] // every, part[SENSOR_MEASUREMENT]["sequence"])
        actuated.take(part[CONTROLLER_STEP]["sequence"], part[PLANT_ACTUATION]["sequence"])
    legs = {
        "measurement": measured,
        "update to netem": _Unmatched().take(events, outcomes.sequence),
        "update to controller": _Unmatched().take(_left_until(outcomes, last_ns), received),
        "actuation": actuated,
    }
    for flow in record.scenario.network.flows[1:]:
        name, answers = flow.name.lower(), packet_outcomes(record, flow)
        sent, arrived = (
            record.columns(table, "sequence")["sequence"] for table in _SENT_RECEIVED[flow]
        )
        legs.pop(name, None)
        legs[f"{name} to netem"] = _Unmatched().take(sent, answers.sequence)
        legs[f"{name} to {ENDS[flow].receiver}"] = _Unmatched().take(
            _left_until(answers, last_ns), arrived
        )
    complete = all(record.reports.get(role, {}).get("ended") == HORIZON for role in LOOP_ROLES)
    return {leg: one.count(complete=complete) for leg, one in legs.items()}


def _left_until(outcomes: PacketOutcome, last_ns: float) -> NDArray[np.int64]:
    """Return the numbers of the datagrams that were forwarded, and were due until then."""
    return outcomes.sequence[outcomes.forwarded & (outcomes.due_ns <= last_ns)]


class _Unmatched:
    """Finds the sent numbers that were not received, part by part; both ascend."""

    def __init__(self) -> None:
        self._sent = np.zeros(0, np.int64)
        self._newest = -1

    def take(self, sent: NDArray[np.int64], arrived: NDArray[np.int64]) -> "_Unmatched":
        """Add the next numbers; one is received in the same part as it is sent, or later."""
        self._newest = max(self._newest, int(arrived.max(initial=-1)))
        self._sent = np.setdiff1d(np.concatenate([self._sent, sent]), arrived)
        return self

    def count(self, *, complete: bool) -> int:
        """Return how many were lost; in a run that was stopped, one in flight is not lost."""
        return int((complete | (self._sent <= self._newest)).sum())


def missing_rows(record: RunRecord) -> Counter[str]:
    """Return the number of rows that a process wrote and the record does not contain, by table.

    For a process that died without a report: by process, from the gaps in its input numbers.
    """
    missing: Counter[str] = Counter()
    for role in LOOP_ROLES:
        for life in record.lives(role):
            if life.report is None:
                missing[role] += life.missing_inputs
                continue
            for table, count in life.rows.items():
                missing[table] += life.report["rows"][table] - count
    return missing


def reported_violations(record: RunRecord) -> list[ViolationPart]:
    """Return the violations that the processes reported, and a loss burst at the end of the run.

    The burst at the end is computed here, because no process can detect it.
    """
    found = [
        ViolationPart(
            t_s=notice["t_ns"] * 1e-9,
            process=notice["process"],
            cause=_cause(notice["text"]),
            what=notice["text"],
        )
        for notice in record.notices
        if notice["level"] == VIOLATION
    ]
    outcomes = packet_outcomes(record)
    delivered = np.flatnonzero(~outcomes.lost)
    first = int(delivered[-1]) + 1 if len(delivered) else 0
    mansd = _largest_mansd(record, int(outcomes.event_ns[first - 1]) if first else 0)
    dropped = len(outcomes.lost) - first
    if dropped > mansd:
        what = f"MANSD violated: the last {dropped} updates were lost, at most {mansd} assumed"
        at_s = float(outcomes.event_ns[first + mansd]) * 1e-9
        found.append(ViolationPart(t_s=at_s, process="netem", cause=DROPOUTS, what=what))
    return found


def _cause(text: str) -> str:
    """Return the cause of a violation from a process's message."""
    if "a change" in text:
        return "change"
    rule, violated, _ = text.partition(" violated: ")
    return rule if violated and rule != "MANSD" else DROPOUTS


def list_violations(
    reported: Sequence[ViolationPart], observed: Sequence[AssumptionViolation]
) -> list[ViolationPart]:
    """Return all violations of a run: those reported by processes, then those found in the record.

    A violation of M − 1 that a process reported is not repeated.
    """
    known = {one.cause for one in reported}
    return [*reported] + [
        ViolationPart(t_s=one.t_s, process="recorder", cause=one.cause, what=one.text)
        for one in observed
        if one.cause not in known
    ]


def _largest_mansd(record: RunRecord, since_ns: int) -> int:
    """The largest M − 1 in force at any time from ``since_ns`` on."""
    changes = changes_of(record)
    caps = [record.scenario.network.mansd, *(one.scenario.network.mansd for one in changes)]
    ends_ns = [*(one.everywhere_ns for one in changes), NEVER_NS]
    return max(cap for cap, end_ns in zip(caps, ends_ns, strict=True) if end_ns > since_ns)
