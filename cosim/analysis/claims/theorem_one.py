"""Theorem 1's own Δ (eq:Normec), which exists after a run only: from its recorded trajectory."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cosim.record.align import AlignedRun
from cosim.record.run_record import RunRecord
from noack.core.linear_systems import Propagator, spectral_abscissa
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT
from noack.theory.paper_bounds import Interval, longest_interval_s, theorem_1

Indices = NDArray[np.int64]


def theorem_one(record: RunRecord, joined: AlignedRun, until_s: float = math.inf) -> float | None:
    """The largest Δ over all stretches between two deliveries; None if there is none to be had.

    Theorem 3's for a hold. With W ≠ I the theorem says nothing, and neither does this. Nor does it
    from ``until_s`` on, when the run has left what the theorem presupposes.
    """
    loop, trigger = record.loop, record.scenario.decaying
    if loop.weight is not None:
        return None
    event = record[SENSOR_MEASUREMENT]["event"]
    events = np.flatnonzero(event != NO_SEQUENCE)
    starts = events[joined.t_ns[events] * 1e-9 < until_s]
    if not len(starts):
        return None
    ends = [*events[1:], len(joined.t_ns) - 1][: len(starts)]
    longest_s = [
        longest_interval_s(interval, trigger.beta, trigger.alpha_per_s, _decay(record))
        for interval in _intervals(record, joined, starts, ends)
    ]
    # Δ grows with the stretch: of the stretches that begin with an event, the longest is enough.
    stretches: dict[int, int] = {}
    first = 0  # of the missed ones
    for index, start in enumerate(starts):
        while first <= index and event[starts[first]] <= joined.received[start]:
            first += 1
        if first <= index and joined.received[start] != NO_SEQUENCE:
            stretches[first] = index + 1
    found = [
        theorem_1(loop.H, trigger.alpha_per_s, missed_s)
        for missed_s in _longest([longest_s[first:end] for first, end in stretches.items()])
    ]
    delta = max(found, default=1.0)
    return delta if math.isfinite(delta) else None


def _longest(stretches: Sequence[Sequence[float]]) -> list[Sequence[float]]:
    """Those that no other one exceeds throughout: Δ grows with every δ̃_k, the sums from k on."""
    most = max(map(len, stretches), default=0)
    reaches = np.zeros((len(stretches), most))
    for row, stretch in zip(reaches, stretches, strict=True):
        row[: len(stretch)] = np.cumsum(stretch[::-1])[::-1]
    kept: list[int] = []
    for place in np.argsort(-reaches.sum(axis=1), kind="stable").tolist():
        if not (reaches[kept] >= reaches[place]).all(axis=1).any():
            kept.append(place)
    return [stretches[place] for place in kept]


def _decay(record: RunRecord) -> float:
    """κ, a rate at which the model decays: α where it can."""
    H = record.loop.H
    if not H.any():
        return 0.0
    return min(record.scenario.decaying.alpha_per_s, max(-spectral_abscissa(H), 0.0))


def _intervals(
    record: RunRecord, joined: AlignedRun, starts: Indices, ends: Sequence[int]
) -> list[Interval]:
    """From every event of ``starts`` to the next."""
    propagate = Propagator(record.loop.H)
    found = []
    for first, end in zip(starts, ends, strict=True):
        index = np.arange(first, end + 1)
        ages_ns = joined.t_ns[index] - joined.t_ns[first]
        model = [propagate(joined.x[first], int(age_ns)) for age_ns in ages_ns]
        found.append(
            Interval(
                np.asarray(joined.t_ns[index] * 1e-9),
                np.linalg.norm(joined.x[index], axis=1),
                np.linalg.norm(np.array(model), axis=1),
            )
        )
    return found
