"""Theorem 1's Δ from a recorded trajectory: the largest over all intervals between two deliveries.

It depends on the trajectory and on the true plant, so it can be computed only after a run.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.align import aligned_parts
from cosim.record.run_record import RunRecord
from noack.core.linear_systems import Matrix, Propagator, spectral_abscissa
from noack.protocol.record_tables import NO_SEQUENCE
from noack.theory.paper import InterEventTrajectory, longest_interval_s, theorem_1

_MOST_MISSED = 200
"""Largest number of missing events for which Δ is computed: this takes seconds, more take minutes."""


class _Start(NamedTuple):
    """An event from which an interval starts."""

    event: int
    received: int
    """The controller's newest update at that time."""


def trajectory_delta(record: RunRecord, until_s: float = math.inf) -> float | None:
    """Return Theorem 1's Δ from a recorded trajectory; None if there is none, or if W ≠ I.

    It is not computed either where many updates are in flight, as under a long delay. The theorem's
    assumptions hold until ``until_s``.
    """
    loop, trigger = record.loop, record.scenario.decaying
    if loop.weight is not None:
        return None
    kappa = _model_decay(record)
    starts, longest_s = [], []
    for start, interval in _intervals(record, until_s):
        starts.append(start)
        longest_s.append(longest_interval_s(interval, trigger.beta, trigger.alpha_per_s, kappa))
    if not starts:
        return None
    # Δ increases with the interval: only the longest interval from each event is needed.
    stretches: dict[int, int] = {}
    first = 0  # index of the first missed event
    for index, start in enumerate(starts):
        while first <= index and starts[first].event <= start.received:
            first += 1
        if first <= index and start.received != NO_SEQUENCE:
            stretches[first] = index + 1
    if max((end - first for first, end in stretches.items()), default=0) > _MOST_MISSED:
        return None
    deltas = [
        theorem_1(loop.H, trigger.alpha_per_s, missed_s)
        for missed_s in undominated([longest_s[first:end] for first, end in stretches.items()])
    ]
    delta = max(deltas, default=1.0)
    return delta if math.isfinite(delta) else None


def undominated(stretches: Sequence[Sequence[float]]) -> list[Sequence[float]]:
    """Return the sequences that no other one dominates: only they can have the largest Δ.

    Δ increases with every δ̃_k, the sum of a sequence from its interval k on.
    """
    most = max(map(len, stretches), default=0)
    reaches = np.zeros((len(stretches), most))
    for row, stretch in zip(reaches, stretches, strict=True):
        row[: len(stretch)] = np.cumsum(stretch[::-1])[::-1]
    largest: list[int] = []
    for index in np.argsort(-reaches.sum(axis=1), kind="stable").tolist():
        if not (reaches[largest] >= reaches[index]).all(axis=1).any():
            largest.append(index)
    return [stretches[index] for index in largest]


def _model_decay(record: RunRecord) -> float:
    """Return κ, a decay rate of the model: α if the model decays at least that fast."""
    H = record.loop.H
    if not H.any():
        return 0.0
    return min(record.scenario.decaying.alpha_per_s, max(-spectral_abscissa(H), 0.0))


def _intervals(record: RunRecord, until_s: float) -> Iterator[tuple[_Start, InterEventTrajectory]]:
    """Yield the trajectory from every event before ``until_s`` to the next event."""
    propagate = Propagator(record.loop.H)

    def interval(t_ns: NDArray[np.int64], x: Matrix) -> InterEventTrajectory:
        model = [propagate(x[0], int(age_ns)) for age_ns in t_ns - t_ns[0]]
        norms = (np.linalg.norm(states, axis=1) for states in (x, np.array(model)))
        return InterEventTrajectory(np.asarray(t_ns * 1e-9), *norms)

    start: _Start | None = None
    t_ns, x = np.zeros(0, np.int64), np.zeros((0, record.loop.n))
    for part in aligned_parts(record):
        aligned, event = part.aligned, part.rows["event"]
        before = len(t_ns)
        t_ns, x = np.append(t_ns, aligned.t_ns), np.concatenate([x, aligned.x])
        first = 0
        for row in np.flatnonzero(event != NO_SEQUENCE).tolist():
            last = before + row
            if start is not None:
                yield start, interval(t_ns[first : last + 1], x[first : last + 1])
            start, first = None, last
            if aligned.t_ns[row] * 1e-9 >= until_s:
                return
            start = _Start(int(event[row]), int(aligned.received[row]))
        if start is None:
            first = len(t_ns)
        t_ns, x = t_ns[first:], x[first:]
    if start is not None:
        yield start, interval(t_ns, x)
