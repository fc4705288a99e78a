"""Losses of a run: updates in the network, datagrams elsewhere, rows of the record."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from cosim.analysis.claims.observed_conditions import AssumptionViolation
from cosim.analysis.summary_model import AcknowledgementsPart, ViolationPart
from cosim.record.packet_outcomes import PacketOutcome, packet_outcomes
from cosim.record.recorded_changes import NEVER_NS, changes_of
from cosim.record.run_record import RunRecord
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    NO_SEQUENCE,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    Fate,
    effective,
)
from noack.protocol.topology import LOOP_ROLES
from noack.protocol.wire_format import Flow
from noack.runtime.life_cycle import HORIZON

VIOLATION = "violation"
"""Level of a notice: a process detected that an assumption was violated."""


def drops_by_cause(outcomes: PacketOutcome) -> dict[str, int]:
    """Return the number of lost updates by cause, without causes of no losses."""
    fates = outcomes.rows["fate"]
    causes = {one.name.lower(): int((fates == one).sum()) for one in Fate if not one.effective}
    causes["delivered_out_of_order"] = int((effective(fates) & outcomes.lost).sum())
    return {cause: n for cause, n in causes.items() if n}


def acknowledgements(record: RunRecord) -> AcknowledgementsPart:
    """The outcome of the acknowledgements; the controller sends one for each update."""
    outcomes = packet_outcomes(record, Flow.ACKNOWLEDGEMENT)
    return AcknowledgementsPart(
        sent=len(record[CONTROLLER_DELIVERY]),
        lost=int(outcomes.lost.sum()),
        longest_loss_burst=outcomes.longest_loss_burst(),
        received=len(record[SENSOR_ACKNOWLEDGEMENT]),
    )


def unintended_losses(record: RunRecord) -> dict[str, int]:
    """Return the number of datagrams lost without a decision of the emulator, by hop."""
    sensor, outcomes = record[SENSOR_MEASUREMENT], packet_outcomes(record)
    every = record.scenario.plant.measure_every
    sent = record[PLANT_STEP]["sequence"]
    received = record[CONTROLLER_DELIVERY]["sequence"]
    legs = {
        "measurement": (sent[sent % every == 0] // every, sensor["sequence"]),
        "update to netem": (sensor["event"][sensor["event"] != NO_SEQUENCE], outcomes.sequence),
        "update to controller": (outcomes.sequence[outcomes.forwarded], received),
        "actuation": (record[CONTROLLER_STEP]["sequence"], record[PLANT_ACTUATION]["sequence"]),
    }
    if record.scenario.protocol.acknowledges:
        answers = packet_outcomes(record, Flow.ACKNOWLEDGEMENT)
        arrived = record[SENSOR_ACKNOWLEDGEMENT]["sequence"]
        legs["acknowledgement to netem"] = (received, answers.sequence)
        legs["acknowledgement to sensor"] = (answers.sequence[answers.forwarded], arrived)
    complete = all(record.reports.get(role, {}).get("ended") == HORIZON for role in LOOP_ROLES)
    lost: dict[str, int] = {}
    for leg, (out, arrived) in legs.items():
        if not complete:  # a datagram in flight when a process ended is not lost
            out = out[out <= arrived.max(initial=-1)]
        lost[leg] = int(np.setdiff1d(out, arrived).size)
    return lost


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
            cause="change" if "a change" in notice["text"] else "dropouts",
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
        found.append(ViolationPart(t_s=at_s, process="netem", cause="dropouts", what=what))
    return found


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
