"""The loss rate that the settings of a link make in the long run, under their cap.

Each loss model, and whatever else is drawn, is a Markov chain that moves with every datagram; all
of them together are one, with transition matrix P and, for each state, the probability ℓ that the
datagram is not effectively delivered. With A = P diag(ℓ) and B = P diag(1 − ℓ), and v the state's
distribution at a delivered datagram,

* E D = v Σ_{k=1..m} A^k 1 datagrams are lost before the next delivery, m at most, and
* v is stationary under Σ_{k<m} A^k B + A^m P, as the datagram after m losses must pass.

The loss rate is E D/(E D + 1). For independent losses it is p(1 − p^m)/(1 − p^{m+1}).
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.rules.normal import score
from noack.config.impairments import (
    BernoulliLoss,
    Blackout,
    Corrupt,
    Delay,
    Duplicate,
    FourStateLoss,
    GilbertElliottLoss,
    Impairment,
    LinkSettings,
    Loss,
    LossOf,
    NoLoss,
    PeriodicLoss,
    Rate,
    Reorder,
    ScriptedLoss,
    TraceLoss,
    WorstCaseLoss,
)

Array = NDArray[np.float64]

_MOST_STATES = 256
_LONGEST_PATTERN = 10_000_000


class LossPrediction(NamedTuple):
    """A loss rate, or why it cannot be told."""

    rate: float | None
    """Share of a flow's datagrams that are dropped or corrupted, in the long run."""
    note: str
    """Why there is none; or what it does not count; or empty."""


def predicted_loss(settings: LinkSettings) -> float | None:
    """Return the share of a flow's datagrams that are dropped or corrupted in the long run.

    None where it cannot be told; :func:`predict` says why.
    """
    return predict(settings).rate


@lru_cache(maxsize=64)
def predict(settings: LinkSettings) -> LossPrediction:
    """Predict the loss rate of a direction; its files are read already.

    What overflows a queue or is overtaken is not counted: it depends on when datagrams come.
    """
    impairments = settings.impairments
    if any(isinstance(one, Blackout) for one in impairments):
        return LossPrediction(None, "what a blackout takes depends on when datagrams come")
    try:
        parts = [part for one in impairments for part in _parts(one)]
        rate = _capped_rate(parts, settings.mansd)
    except _NotKnownError as error:
        return LossPrediction(None, str(error))
    notes = []
    if any(isinstance(one, Rate) for one in impairments):
        notes.append("as long as no queue overflows")
    if settings.mansd != 0 and _can_overtake(impairments):
        notes.append("not counting what is overtaken (stale)")
    return LossPrediction(rate, "; ".join(notes))


def _can_overtake(impairments: Sequence[Impairment]) -> bool:
    """Whether a datagram may leave before one that came before it."""
    delays, makes_stale = False, False
    for one in impairments:
        match one:
            case Rate():
                delays, makes_stale = True, False  # it serves in the order of arrival
            case Delay():
                varies = bool(one.jitter_s or one.samples_s or one.file)
                delays, makes_stale = delays or varies or one.delay_s > 0, makes_stale or varies
            case Reorder():
                makes_stale = makes_stale or (delays and one.probability > 0)
    return makes_stale


class _NotKnownError(Exception):
    """The rate cannot be told; says why."""


class _Chain(NamedTuple):
    """An impairment as a Markov chain with n states; it moves, then does what it does, or not."""

    start: Array
    """(n,) Distribution before the first datagram."""
    moves: Array
    """(n, n) Transition matrix."""
    does: Array
    """(n,) Probability that it does it."""
    what: str = "lose"
    """``lose``, ``corrupt`` or ``duplicate``."""
    probability: float = 0.0
    """Probability that it does it to a copy."""


class _Pattern(NamedTuple):
    """A loss whose pattern repeats."""

    lost: NDArray[np.bool_]
    """(period,)"""

    @property
    def chain(self) -> _Chain:
        """The same as a chain."""
        period = len(self.lost)
        return _Chain(
            np.eye(period)[-1], np.roll(np.eye(period), 1, axis=1), self.lost.astype(float)
        )


def _parts(impairment: Impairment) -> Sequence[_Chain | _Pattern]:
    match impairment:
        case LossOf():
            return _loss_parts(impairment.loss)
        case Corrupt() | Duplicate():
            p = impairment.probability
            chain = _chance_chain(p, impairment.correlation)
            return [chain._replace(what=impairment.kind, probability=p)]
        case Delay() | Reorder() | Rate() | Blackout():
            return []


def _loss_parts(loss: Loss) -> Sequence[_Chain | _Pattern]:
    match loss:
        case NoLoss():
            return []
        case BernoulliLoss():
            return [_chance_chain(loss.probability, loss.correlation)]
        case WorstCaseLoss():
            return [_Pattern(np.ones(1, bool))]
        case GilbertElliottLoss():
            p, r = loss.transitions
            moves = np.array([[1 - p, p], [r, 1 - r]])
            does = np.array([loss.loss_in_good, loss.loss_in_bad])
            return [_Chain(np.array([1.0, 0.0]), moves, does)]
        case FourStateLoss():
            moves = np.array([
                [1 - loss.p13 - loss.p14, 0.0, loss.p13, loss.p14],
                [0.0, 1 - loss.p23, loss.p23, 0.0],
                [loss.p31, loss.p32, 1 - loss.p31 - loss.p32, 0.0],
                [1.0, 0.0, 0.0, 0.0],
            ])  # fmt: skip
            does = np.array([0.0, 0.0, 1.0, 1.0])
            return [_Chain(np.eye(4)[0], np.maximum(moves, 0.0), does)]
        case PeriodicLoss():
            lost = np.arange(min(loss.burst, _LONGEST_PATTERN)) + loss.first
            return [_pattern(loss.period, lost % loss.period)]
        case ScriptedLoss():
            if not loss.repeat_every:
                raise _NotKnownError(
                    "a script that is played once loses the same of a flow however long it is"
                )
            return [_pattern(loss.repeat_every, np.array(loss.lost, dtype=np.int64))]
        case TraceLoss():
            raise _NotKnownError(f"{loss.file} has not been read")


def _pattern(period: int, lost: NDArray[np.int64]) -> _Pattern:
    if period > _LONGEST_PATTERN:
        raise _NotKnownError(f"its pattern repeats only after {period} datagrams")
    flags = np.zeros(period, bool)
    flags[lost] = True
    return _Pattern(flags)


def _chance_chain(probability: float, correlation: float) -> _Chain:
    if correlation == 0.0 or probability in (0.0, 1.0):
        return _Chain(np.ones(1), np.ones((1, 1)), np.array([probability]))
    nodes, weights, does = _nodes(probability, correlation)
    innovation = math.sqrt(1 - correlation**2)
    steps = (nodes - correlation * nodes[:, None]) / innovation
    moves = _stochastic(np.exp(-(steps**2) / 2) * weights)
    start = np.exp(-(nodes**2) / 2) * weights
    return _Chain(start / start.sum(), moves, does)


def _nodes(probability: float, correlation: float) -> tuple[Array, Array, Array]:
    """Gauss nodes on both sides of the threshold that the latent process crosses."""
    threshold, edge = -score(probability), 8.3  # no uniform number has a score beyond
    innovation = math.sqrt(1 - correlation**2)
    sides = ((-edge, min(threshold, edge), 0.0), (max(threshold, -edge), edge, 1.0))
    counts = [max(12, math.ceil(3 * (high - low) / innovation)) for low, high, _ in sides]
    if sum(counts) > _MOST_STATES:
        raise _NotKnownError(f"a correlation of {correlation:g} is too high to compute with")
    parts = []
    for count, (low, high, does) in zip(counts, sides, strict=True):
        x, w = np.polynomial.legendre.leggauss(count)
        half = (high - low) / 2
        parts.append((low + half * (x + 1), half * w, np.full(count, does)))
    nodes, weights, flags = (np.concatenate(part) for part in zip(*parts, strict=True))
    return nodes, weights, flags


def _capped_rate(parts: Sequence[_Chain | _Pattern], mansd: int | None) -> float:
    patterns = [part for part in parts if isinstance(part, _Pattern)]
    if len(patterns) == len(parts):
        return _pattern_rate([part.lost for part in patterns], mansd)
    start, moves, ineffective = _together(parts)
    if mansd is None:
        return float(_long_run(start, moves) @ ineffective)
    lost, passed = moves * ineffective, moves * (1 - ineffective)
    total, power = _geometric(lost, mansd)
    at_delivery = _long_run(start, _stochastic(total @ passed + power @ moves))
    in_a_row = float((at_delivery @ lost @ total).sum())
    return in_a_row / (in_a_row + 1)


def _pattern_rate(patterns: Sequence[NDArray[np.bool_]], mansd: int | None) -> float:
    """What patterns lose together, counted over the period that they have in common."""
    period = math.lcm(*map(len, patterns))
    if period > _LONGEST_PATTERN:
        raise _NotKnownError(f"their pattern repeats only after {period} datagrams")
    lost = np.zeros(period, bool)
    for pattern in patterns:
        lost |= np.resize(pattern, period)
    if mansd is None:
        return float(lost.mean())
    if lost.all():
        return mansd / (mansd + 1)
    passed = np.flatnonzero(~lost)
    runs = np.diff(passed, append=passed[0] + period) - 1
    return float((runs - runs // (mansd + 1)).sum() / period)


def _together(parts: Sequence[_Chain | _Pattern]) -> tuple[Array, Array, Array]:
    """The joint chain: its start, its matrix, the probability of no effective delivery."""
    states = math.prod(len(part.lost if isinstance(part, _Pattern) else part.start)
                       for part in parts)  # fmt: skip
    if states > _MOST_STATES:
        raise _NotKnownError(f"together they have {states} states, too many to compute with")
    start: Array = np.ones(1)
    moves: Array = np.ones((1, 1))
    chains = [part.chain if isinstance(part, _Pattern) else part for part in parts]
    done: list[_Chain] = []
    for chain in chains:
        n, others = len(chain.start), len(start)
        start = np.kron(start, chain.start).astype(np.float64)
        moves = np.kron(moves, chain.moves).astype(np.float64)
        done = [one._replace(does=np.repeat(one.does, n)) for one in done]
        done.append(chain._replace(does=np.tile(chain.does, others)))
    return start, moves, _ineffective(done, states)


def _ineffective(chains: Sequence[_Chain], states: int) -> Array:
    """(states,) Probability that a datagram is lost, or no intact copy of it leaves."""
    passes = np.ones(states)
    ways = np.zeros((2, 3, states))
    """By: is the datagram intact, corrupt; is there no copy, an intact, a corrupt one."""
    ways[0, 0] = 1.0
    for chain in chains:
        if chain.what == "lose":
            passes = passes * (1 - chain.does)
        elif chain.what == "duplicate":
            copied = ways.sum(axis=1) * chain.does
            ways *= 1 - chain.does
            ways[0, 1] += copied[0]
            ways[1, 2] += copied[1]
        else:
            corrupted = ways[0] * chain.does
            ways += np.stack([-corrupted, corrupted])
            copies = ways[:, 1] * chain.probability
            ways[:, 1] -= copies
            ways[:, 2] += copies
    ineffective: Array = 1 - passes * (1 - ways[1, 0] - ways[1, 2])
    return ineffective


def _geometric(matrix: Array, terms: int) -> tuple[Array, Array]:
    """Return Σ_{k<terms} Mᵏ and M^terms, by doubling."""
    total, power = np.zeros_like(matrix), np.eye(len(matrix))
    for bit in bin(terms)[2:]:
        total, power = total + power @ total, power @ power
        if bit == "1":
            total, power = total + power, power @ matrix
    return total, power


def _long_run(start: Array, moves: Array) -> Array:
    """Distribution over the states in the long run, also of a chain that is periodic.

    The mean over 2⁶⁴ steps, by doubling.
    """
    mean, power = np.eye(len(start)), moves
    for _ in range(64):
        mean, power = (mean + power @ mean) / 2, _stochastic(power @ power)
    distribution: Array = start @ mean
    return distribution


def _stochastic(matrix: Array) -> Array:
    """Let rows add up to 1, as rounding would grow; what is next to nothing is slow to compute."""
    kept: Array = np.where(matrix < 1e-100, 0.0, matrix)
    kept /= kept.sum(axis=1, keepdims=True)
    return kept
