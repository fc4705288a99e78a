"""The expected loss rate of a link under its guarantee.

Each random feature is a Markov chain that advances with every packet. Together they are one chain
with transition matrix P; in each state, a packet is not effectively delivered with probability ℓ.
Let A = P diag(ℓ), B = P diag(1 − ℓ), m = M − 1 the cap, and v the distribution of the state at a
delivered packet. Then

* E D = v Σ_{k=1..m} A^k 1 is the expected number of losses before the next delivery, and
* v is stationary under Σ_{k<m} A^k B + A^m P, since the packet after m losses must pass.

The loss rate is E D/(E D + 1). For independent losses it is p(1 − p^m)/(1 − p^{m+1}). With windows
or recovery, the states of the guarantee are part of the chain; see
:mod:`noack.impairments.guarantee_chain`.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.impairments.constraints import guarantee_of
from noack.impairments.guarantee_chain import constrained_rate, pattern_rate
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_guarantee import LossGuarantee
from noack.impairments.markov_chain import (
    LONGEST_PATTERN,
    MOST_STATES,
    Array,
    Chain,
    NotPredictableError,
    Pattern,
    stochastic,
)


class LossPrediction(NamedTuple):
    """A loss rate, or why there is none."""

    rate: float | None
    """Expected share of a flow's packets that are dropped or corrupted."""
    note: str
    """Why there is no rate, or the condition under which the rate holds; else empty."""


@lru_cache(maxsize=64)
def predict(settings: LinkSettings) -> LossPrediction:
    """Predict the loss rate of a direction; the settings must not name files.

    Packets that overflow a queue or are delivered out of order do not count, since their number
    depends on the arrival times.
    """
    impairments = settings.impairments
    try:
        parts = [part for one in impairments for part in one.chains()]
        if settings.constraints:
            rate = _constrained_rate(parts, guarantee_of(settings.mansd, settings.constraints))
        else:
            rate = _capped_rate(parts, settings.mansd)
    except NotPredictableError as error:
        return LossPrediction(None, str(error))
    notes = list(dict.fromkeys(one.prediction_note for one in impairments if one.prediction_note))
    delayed, reordered = False, False
    for one in impairments:
        delayed, reordered = one.reorders(delayed, reordered)
    if settings.longest_burst != 0 and reordered:
        notes.append("not counting packets delivered out of order (stale)")
    return LossPrediction(rate, "; ".join(notes))


def joint_chain(settings: LinkSettings) -> tuple[Array, Array, Array]:
    """Return the chain of all impairments: start (n,), matrix (n, n), probability of loss (n,).

    The settings must not name files.

    Raises:
        NotPredictableError: there is no such chain; the message is the reason.
    """
    return _together([part for one in settings.impairments for part in one.chains()])


def _constrained_rate(parts: Sequence[Chain | Pattern], guarantee: LossGuarantee) -> float:
    patterns = [part.lost for part in parts if isinstance(part, Pattern)]
    if len(patterns) == len(parts):
        return pattern_rate(_together_lost(patterns), guarantee)
    return constrained_rate(*_together(parts), guarantee)


def _capped_rate(parts: Sequence[Chain | Pattern], mansd: int | None) -> float:
    patterns = [part for part in parts if isinstance(part, Pattern)]
    if len(patterns) == len(parts):
        return _pattern_rate([part.lost for part in patterns], mansd)
    start, moves, ineffective = _together(parts)
    if mansd is None:
        return float(_stationary(start, moves) @ ineffective)
    lost, passed = moves * ineffective, moves * (1 - ineffective)
    total, power = _geometric(lost, mansd)
    at_delivery = _stationary(start, stochastic(total @ passed + power @ moves))
    burst = float((at_delivery @ lost @ total).sum())
    return burst / (burst + 1)


def _pattern_rate(patterns: Sequence[NDArray[np.bool_]], mansd: int | None) -> float:
    """Return the loss rate of several patterns combined, counted over their common period."""
    lost = _together_lost(patterns)
    period = len(lost)
    if mansd is None:
        return float(lost.mean())
    if lost.all():
        return mansd / (mansd + 1)
    passed = np.flatnonzero(~lost)
    bursts = np.diff(passed, append=passed[0] + period) - 1
    return float((bursts - bursts // (mansd + 1)).sum() / period)


def _together_lost(patterns: Sequence[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """Return the losses of several patterns combined, over their common period."""
    period = math.lcm(*map(len, patterns))
    if period > LONGEST_PATTERN:
        raise NotPredictableError(f"the loss patterns repeat together only after {period} packets")
    lost = np.zeros(period, bool)
    for pattern in patterns:
        lost |= np.resize(pattern, period)
    return lost


def _together(parts: Sequence[Chain | Pattern]) -> tuple[Array, Array, Array]:
    """Return the joint chain: start, matrix, probability of no effective delivery."""
    states = math.prod(len(part.lost if isinstance(part, Pattern) else part.start)
                       for part in parts)  # fmt: skip
    if states > MOST_STATES:
        raise NotPredictableError(
            f"together the impairments have {states} states, too many to compute with"
        )
    start: Array = np.ones(1)
    moves: Array = np.ones((1, 1))
    chains = [part.chain if isinstance(part, Pattern) else part for part in parts]
    done: list[Chain] = []
    for chain in chains:
        n, others = len(chain.start), len(start)
        start = np.kron(start, chain.start).astype(np.float64)
        moves = np.kron(moves, chain.moves).astype(np.float64)
        done = [one._replace(acts=np.repeat(one.acts, n)) for one in done]
        done.append(chain._replace(acts=np.tile(chain.acts, others)))
    return start, moves, _ineffective(done, states)


def _ineffective(chains: Sequence[Chain], states: int) -> Array:
    """Return the probability (states,) that no intact copy of a packet leaves."""
    passes = np.ones(states)
    shares = np.zeros((2, 3, states))
    """Axis 0: packet intact, corrupt. Axis 1: no copy, intact copy, corrupt copy. Axis 2: state."""
    shares[0, 0] = 1.0
    for chain in chains:
        if chain.what == "lose":
            passes = passes * (1 - chain.acts)
        elif chain.what == "duplicate":
            copied = shares.sum(axis=1) * chain.acts
            shares *= 1 - chain.acts
            shares[0, 1] += copied[0]
            shares[1, 2] += copied[1]
        else:
            corrupted = shares[0] * chain.acts
            shares += np.stack([-corrupted, corrupted])
            copies = shares[:, 1] * chain.probability
            shares[:, 1] -= copies
            shares[:, 2] += copies
    ineffective: Array = 1 - passes * (1 - shares[1, 0] - shares[1, 2])
    return ineffective


def _geometric(matrix: Array, terms: int) -> tuple[Array, Array]:
    """Return Σ_{k<terms} Mᵏ and M^terms, by doubling."""
    total, power = np.zeros_like(matrix), np.eye(len(matrix))
    for bit in bin(terms)[2:]:
        total, power = total + power @ total, power @ power
        if bit == "1":
            total, power = total + power, power @ matrix
    return total, power


def _stationary(start: Array, moves: Array) -> Array:
    """Return the mean distribution over the states, by doubling over 2⁶⁴ steps.

    The mean exists for periodic chains, too.
    """
    mean, power = np.eye(len(start)), moves
    for _ in range(64):
        mean, power = (mean + power @ mean) / 2, stochastic(power @ power)
    distribution: Array = start @ mean
    return distribution
