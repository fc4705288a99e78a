"""Certificates under persistent causes: what decays and what persists, bounded apart and added.

For given events all inequalities of a certificate are linear in functions of time, v ≤ T v + g,
with a positive T. So for g = g₁ + g₂, v is at most the sum of both solutions: one for the start and
βe^{−αt}, scaled by e^{αt}; the other, not scaled, for disturbances, noise and the floor ε of the
threshold, which is at most βe^{−αt} + ε. Both use the same δ. An event needs a threshold of at
least λβe^{−αt} + (1 − λ)ε, for any λ in [0, 1].
"""

import contextlib
import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from noack.core.linear_systems import Vector
from noack.theory.certificate import solve_sum
from noack.theory.certificate_terms import Constants, NetworkConditions, Part, VoidError
from noack.theory.kernel_bounds import NotDecayingError

_RATES = (0.05, 0.2, 0.4, 0.7)
"""Rates that are tried, as shares of the loop's decay rate."""
SHARES = (0.5, 0.2, 0.8)
"""Values of λ that are tried."""


def solve_divided(
    decaying: Part,
    persistent: Part,
    conditions: NetworkConditions,
    earlier_error: float = 0.0,
    *,
    structured: bool = True,
    shares: Sequence[float] = SHARES,
) -> tuple[Constants, Constants]:
    """Return the constants of both parts, with the λ of ``shares`` for which δ is longest.

    Without ``shares`` δ is searched for only if there is no certificate otherwise.

    Raises:
        VoidError: the loop gain of one part is not below 1.
        NotDecayingError: a mode of the loop decays more slowly than a part's bounds.
    """
    beta, floor = decaying.bound.beta, persistent.bound.beta

    def solved(share: float | None) -> tuple[Constants, Constants]:
        reached = (None, None) if share is None else (share * beta, (1 - share) * floor)
        parts = [
            part._replace(bound=part.bound._replace(reached=level))
            for part, level in zip((decaying, persistent), reached, strict=True)
        ]
        first, second = solve_sum(parts, conditions, earlier_error, structured=structured)
        return first, second

    if floor == 0:
        return solved(None)
    if not shares:
        with contextlib.suppress(VoidError):
            return solved(None)
    tried = [solved(share) for share in shares or SHARES[:1]]
    return max(tried, key=lambda found: found[0].inter_event_s or 0.0)


Found = TypeVar("Found", bound=Sequence[Constants])


def soonest(solved: Callable[[float], Found], decay_per_s: float, start: Vector) -> Found:
    """Return the constants for a rate, where none is given.

    It is the rate at which the first constants' bound of ‖x‖ falls to ‖x(0)‖/10 first.

    Args:
        solved: returns constants for a rate in 1/s.
        decay_per_s: the decay rate of the loop.
        start: x(0), (n,).

    Raises: what ``solved`` raises at the smallest rate.
    """
    size, found = float(np.linalg.norm(start)) or 1.0, list[tuple[float, Found]]()
    for share in _RATES:
        rate_per_s = share * decay_per_s
        try:
            one = solved(rate_per_s)
        except (NotDecayingError, VoidError):
            if not found:
                raise
            break  # larger rates have larger gains
        found.append((math.log(max(10 * one[0].state / size, 1.0)) / rate_per_s, one))
    return min(found, key=lambda one: one[0])[1]
