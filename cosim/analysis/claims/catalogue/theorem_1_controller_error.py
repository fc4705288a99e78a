"""Theorem 1 of the paper, and Theorem 3 for a hold: ‖e_c‖ ≤ Δ βe^{−αt} (eq:Normec).

Its Δ depends on the trajectory and on the true plant, so it can be computed only after a run. It is
the largest one over all intervals between two deliveries.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.claim_definition import Bound, ClaimDefinition, controller_error_bound
from cosim.analysis.claims.run_evidence import RunEvidence
from cosim.record.align import AlignedRun
from cosim.record.run_record import RunRecord
from noack.core.linear_systems import Propagator, spectral_abscissa
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT
from noack.theory.paper_bounds import Interval, longest_interval_s, theorem_1

Indices = NDArray[np.int64]


def trajectory_delta(
    record: RunRecord, joined: AlignedRun, until_s: float = math.inf
) -> float | None:
    """Return Theorem 1's Δ from a recorded trajectory; None if there is none, or if W ≠ I.

    The theorem's assumptions hold until ``until_s``.
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
    kappa = _model_decay(record)
    longest_s = [
        longest_interval_s(interval, trigger.beta, trigger.alpha_per_s, kappa)
        for interval in _intervals(record, joined, starts, ends)
    ]
    # Δ increases with the interval: only the longest interval from each event is needed.
    stretches: dict[int, int] = {}
    first = 0  # index of the first missed event
    for index, start in enumerate(starts):
        while first <= index and event[starts[first]] <= joined.received[start]:
            first += 1
        if first <= index and joined.received[start] != NO_SEQUENCE:
            stretches[first] = index + 1
    found = [
        theorem_1(loop.H, trigger.alpha_per_s, missed_s)
        for missed_s in undominated([longest_s[first:end] for first, end in stretches.items()])
    ]
    delta = max(found, default=1.0)
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
    for place in np.argsort(-reaches.sum(axis=1), kind="stable").tolist():
        if not (reaches[largest] >= reaches[place]).all(axis=1).any():
            largest.append(place)
    return [stretches[place] for place in largest]


def _model_decay(record: RunRecord) -> float:
    """Return κ, a decay rate of the model: α if the model decays at least that fast."""
    H = record.loop.H
    if not H.any():
        return 0.0
    return min(record.scenario.decaying.alpha_per_s, max(-spectral_abscissa(H), 0.0))


def _intervals(
    record: RunRecord, joined: AlignedRun, starts: Indices, ends: Sequence[int]
) -> list[Interval]:
    """Return the trajectory from every event of ``starts`` to the next event."""
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


def _bound(run: RunEvidence) -> Bound | None:
    scenario = run.record.scenario
    if (
        not scenario.coverage.is_certifiable
        or not scenario.coverage.knows_state
        or scenario.decaying.floor > 0
    ):
        return None
    void = run.paper_violation
    until_s = run.part.until_s if void is None else min(run.part.until_s, void.t_s)
    delta = trajectory_delta(run.record, run.joined, until_s)
    if delta is None:
        return None
    level = scenario.decaying.beta * np.exp(-scenario.decaying.alpha_per_s * run.t_s)
    return controller_error_bound(run, "‖e_c‖ ≤ {:.4g} βe^(−αt)", delta * level, delta, void)


CLAIM = ClaimDefinition(
    "the controller's error decays", "Theorem 1 (3 for a hold), Δ from this run's trajectory",
    "a continuous trigger, a network without delay, at most M − 1 consecutive losses",
    _bound, needs_ideal_loop=True,
)  # fmt: skip
