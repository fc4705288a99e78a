"""Reads the conditions of a run from its record, after the run.

``input_origins.py`` reads those of the plant's inputs.
"""

from collections import deque

import numpy as np

from cosim.analysis.claims.observed_conditions import ObservedConditions, PacketLosses
from cosim.analysis.conformance.input_origins import (
    AppliedUpdate,
    PlantInputs,
    SampledSeries,
    Times,
    plant_inputs,
)
from cosim.record.rows import messages_in
from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from netem.core.packet_rows import NETEM_PACKET, effective
from noack.protocol.record_tables import NO_SEQUENCE, PLANT_STEP, SENSOR_MEASUREMENT
from noack.runtime.host_clocks import RECEIVED, allowed_lead_ns

_PACKET_COLUMNS = ("fate", "head")


def read_conditions(record: RunRecord, inputs: PlantInputs | None = None) -> ObservedConditions:
    """Read the conditions from the record of a run; missing updates and inputs count as late.

    ``inputs``: those of its plant, if they are known.
    """
    scenario, inputs = record.scenario, inputs or plant_inputs(record)
    measured = record.columns(SENSOR_MEASUREMENT, "t_ns", "event")
    end_ns = max(0, *(record.last_ns(table) or 0 for table in (PLANT_STEP, SENSOR_MEASUREMENT)))
    is_event = measured["event"] != NO_SEQUENCE
    losses, delay, first_delay_s = _losses_and_delays(
        measured["event"][is_event].tolist(),
        measured["t_ns"][is_event].tolist(),
        inputs.updates,
        _passed(record),
        inputs.start_s,
        end_ns,
    )
    early = [
        (update.applied_ns * 1e-9, update.model_ns * 1e-9)
        for update in inputs.updates
        if update.applied_ns is not None and update.applied_ns < update.model_ns
    ]
    acts_s = [
        (u.model_ns * 1e-9, np.inf if u.applied_ns is None else u.applied_ns * 1e-9) for u in inputs.updates
    ]
    waiting = [(reset_s, at_s) for reset_s, at_s in acts_s if reset_s < at_s]
    clocks = record.clocks
    return ObservedConditions(
        losses=losses,
        sampling=_gaps(measured["t_ns"], end_ns),
        delay=delay,
        hold=inputs.hold,
        lead=inputs.lead,
        start_s=inputs.start_s,
        watchdog=inputs.watchdog,
        safe_input=inputs.safe_input,
        early_messages=_early_messages(record) if clocks else {},
        allowed_leads_s={
            role: allowed_lead_ns(role, clocks) * scenario.speed / NS_PER_S
            for role in (RECEIVED if clocks else ())
        },
        clock_error_s=max((clock.error_ns / NS_PER_S for clock in clocks.values()), default=None),
        reached_s=end_ns * 1e-9,
        early=SampledSeries(*np.array(early).reshape(-1, 2).T),
        waiting=SampledSeries(*np.array(waiting).reshape(-1, 2).T),
        first_delay_s=first_delay_s,
    )


def _gaps(t_ns: Times, end_ns: int) -> SampledSeries:
    """Return the times between measurements, from the start of the run to its end."""
    times_ns = np.concatenate([[0], t_ns, [end_ns]])
    gaps_ns = np.diff(times_ns)
    longer = gaps_ns > 0
    return SampledSeries(times_ns[:-1][longer] * 1e-9, gaps_ns[longer] * 1e-9)


def _early_messages(record: RunRecord) -> dict[str, SampledSeries]:
    """Return by how much messages were received before they were sent, by receiving process."""
    series: dict[str, SampledSeries] = {}
    for role, (table, _) in RECEIVED.items():
        rows = record.columns(table, "t_ns", "now_ns")
        early = rows["t_ns"] > rows["now_ns"]
        t_ns, now_ns = rows["t_ns"][early], rows["now_ns"][early]
        series[role] = SampledSeries(np.maximum(now_ns, 0) * 1e-9, (t_ns - now_ns) * 1e-9)
    return series


def _passed(record: RunRecord) -> dict[int, bool]:
    """Return whether the emulator let each update pass, by number."""
    passed: dict[int, bool] = {}
    for batch in record.batches(NETEM_PACKET, _PACKET_COLUMNS):
        rows, sequences, _ = messages_in(batch)
        for sequence, forwarded in zip(sequences.tolist(), effective(rows["fate"]).tolist(), strict=True):
            passed[sequence] = passed.get(sequence, False) or forwarded
    return passed


def _losses_and_delays(
    events: list[int],
    times_ns: list[int],
    updates: list[AppliedUpdate],
    passed: dict[int, bool],
    start_s: float,
    end_ns: int,
) -> tuple[PacketLosses, SampledSeries, float | None]:
    """Return losses and delays of the events, in order, and the largest delay until the first input.

    An update in flight at the end is not lost; it counts as delivered at the end.
    """
    waiting = deque(updates)
    replaced_after_s, delays, first_delays_ns = list[float](), list[tuple[int, int]](), list[int]()
    for sequence, t_ns in zip(events, times_ns, strict=True):
        while waiting and waiting[0].sequence < sequence:
            waiting.popleft()
        newest = waiting[0] if waiting else None
        applied_ns = end_ns if newest is None or newest.applied_ns is None else newest.applied_ns
        acts_ns, replaced_s = None, 0.0
        if newest is not None and newest.sequence == sequence:
            acts_ns = max(applied_ns, newest.model_ns)
        elif newest is None and passed.get(sequence, True):
            acts_ns = end_ns
        elif not passed.get(sequence, False):
            replaced_s = np.inf
        else:  # it was delivered out of order: a newer update replaced it
            replaced_s = (applied_ns - t_ns) * 1e-9
        replaced_after_s.append(replaced_s)
        if acts_ns is not None and acts_ns * 1e-9 > start_s:
            delays.append((t_ns, max(acts_ns - t_ns, 0)))
        elif acts_ns is not None and np.isfinite(start_s):
            # A delay until the first input is part of the start, which has a limit of its own.
            first_delays_ns.append(max(acts_ns - t_ns, 0))
    late = np.array(delays).reshape(-1, 2)
    return (
        PacketLosses(np.array(times_ns) * 1e-9, np.array(replaced_after_s)),
        SampledSeries(late[:, 0] * 1e-9, late[:, 1] * 1e-9),
        max(first_delays_ns) * 1e-9 if first_delays_ns else None,
    )
