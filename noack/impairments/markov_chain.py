"""A feature as a Markov chain that advances with every packet, to predict loss rates."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.core_library import core

Array = NDArray[np.float64]

MOST_STATES = 256
LONGEST_PATTERN = 10_000_000


class NotPredictableError(Exception):
    """The loss rate cannot be predicted; the message is the reason."""


class Chain(NamedTuple):
    """A Markov chain with n states: for each packet it advances, then may act on the packet."""

    start: Array
    """(n,) Distribution before the first packet."""
    moves: Array
    """(n, n) Transition matrix."""
    acts: Array
    """(n,) Probability in each state that it acts on the packet."""
    what: str = "lose"
    """The action: ``lose``, ``corrupt`` or ``duplicate``."""
    probability: float = 0.0
    """Probability that it acts on a copy."""


class Pattern(NamedTuple):
    """A periodic loss pattern."""

    lost: NDArray[np.bool_]
    """(period,)"""

    @property
    def chain(self) -> Chain:
        """Return the pattern as a Markov chain."""
        period = len(self.lost)
        return Chain(
            np.eye(period)[-1], np.roll(np.eye(period), 1, axis=1), self.lost.astype(float)
        )


def pattern(period: int, lost: Iterable[int]) -> Pattern:
    """Return the pattern in which these packet numbers of every ``period`` packets are lost.

    Raises:
        NotPredictableError: the period is too long.
    """
    if period > LONGEST_PATTERN:
        raise NotPredictableError(f"the loss pattern repeats only after {period} packets")
    flags = np.zeros(period, bool)
    flags[np.fromiter(lost, np.int64)] = True
    return Pattern(flags)


def chance_chain(probability: float, correlation: float, what: str) -> Chain:
    """Return the chain of :mod:`noack.impairments.correlated_chance`, with its action.

    Raises:
        NotPredictableError: the correlation is too high.
    """
    if correlation == 0.0 or probability in (0.0, 1.0):
        certain = np.ones(1), np.ones((1, 1)), np.array([probability])
        return Chain(*certain, what, probability)
    nodes, weights, acts = _nodes(probability, correlation)
    innovation = math.sqrt(1 - correlation**2)
    steps = (nodes - correlation * nodes[:, None]) / innovation
    moves = stochastic(np.exp(-(steps**2) / 2) * weights)
    start = np.exp(-(nodes**2) / 2) * weights
    return Chain(start / start.sum(), moves, acts, what, probability)


def _nodes(probability: float, correlation: float) -> tuple[Array, Array, Array]:
    """Return Gauss nodes and weights on both sides of the latent process's threshold."""
    threshold, edge = (
        -core.noack_normal_score(probability),
        8.3,
    )  # no uniform number has a score beyond
    innovation = math.sqrt(1 - correlation**2)
    sides = ((-edge, min(threshold, edge), 0.0), (max(threshold, -edge), edge, 1.0))
    counts = [max(12, math.ceil(3 * (high - low) / innovation)) for low, high, _ in sides]
    if sum(counts) > MOST_STATES:
        raise NotPredictableError(f"a correlation of {correlation:g} is too high to compute with")
    parts = []
    for count, (low, high, acts) in zip(counts, sides, strict=True):
        x, w = np.polynomial.legendre.leggauss(count)
        half = (high - low) / 2
        parts.append((low + half * (x + 1), half * w, np.full(count, acts)))
    nodes, weights, flags = (np.concatenate(part) for part in zip(*parts, strict=True))
    return nodes, weights, flags


def stochastic(matrix: Array) -> Array:
    """Normalise rows to sum 1, since rounding errors would grow; set tiny, slow entries to 0."""
    rows: Array = np.where(matrix < 1e-100, 0.0, matrix)
    rows /= rows.sum(axis=1, keepdims=True)
    return rows
