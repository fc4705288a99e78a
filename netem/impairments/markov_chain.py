"""A feature as a Markov chain that advances with every packet, and its loss rate under a guarantee.

A guarantee with windows or recovery makes a larger chain. Its state is the joint state s of the
impairments and the state a of the guarantee's automaton. In s a packet is lost with probability
ℓ(s), provided that the automaton allows a loss in a; else it is delivered. The loss rate is Σ π(s,
a) ℓ(s⁺) over the states that allow a loss, with the stationary distribution π, and s⁺ the state of
the impairments after their step.
"""

import math
from collections.abc import Iterable
from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import core
from netem.guarantee.loss_guarantee import LossAutomaton, LossGuarantee, TransitionTable, transition_table

if TYPE_CHECKING:
    from scipy.sparse import csr_array  # slow to import

Array = NDArray[np.float64]
MOST_STATES = 256
"""Most states of a chain of losses."""
LONGEST_PATTERN = 10_000_000
"""Longest period of losses, in packets."""
MOST_JOINT_STATES = 20_000
"""Most states of a chain and a guarantee together."""
_MOST_STEPS = 1_000_000
"""Packets of a periodic pattern that are followed until a state recurs."""
_WARM_UP = 100
"""Steps of the chain after which a likely state is chosen."""


class NotPredictableError(Exception):
    """The loss rate cannot be predicted; the message is the reason."""


def require_scipy() -> None:
    """Raise NotPredictableError where scipy, which the emulator itself does not need, is missing."""
    if find_spec("scipy") is None:
        raise NotPredictableError("predictions need scipy: pip install 'noack-netem[measure]'")


class Chain(NamedTuple):
    """A Markov chain with n states: for each packet it advances, then may act on the packet."""

    start: Array  # (n,) Distribution before the first packet
    transitions: Array  # (n, n) Transition matrix
    acts: Array  # (n,) Probability in each state that it acts on the packet
    action: str = "lose"  # The action: ``lose``, ``corrupt`` or ``duplicate``
    by_number: bool = False  # Whether it acts on a packet's duplicate as it does on the packet

    @property
    def acts_on_duplicate(self) -> Array:
        """(n,) Probability in each state that it acts on a packet's duplicate, as on the next packet."""
        return self.acts if self.by_number else np.asarray(self.transitions @ self.acts)


class PeriodicLosses(NamedTuple):
    """A periodic loss pattern."""

    lost: NDArray[np.bool_]  # (period,)
    begin: int | None = 0  # No packet with a smaller number is lost; None: the phase is random

    @property
    def states(self) -> int:
        """Number of states of the chain.

        Raises:
            NotPredictableError: its start is not known.
        """
        if self.begin is None:
            raise NotPredictableError("a seed chooses where the recorded losses begin")
        return len(self.lost) + (self.begin + 1 if self.begin else 0)

    @property
    def chain(self) -> Chain:
        """Return the pattern as a Markov chain."""
        period = len(self.lost)
        if not self.begin:
            start, transitions = np.eye(period)[-1], np.roll(np.eye(period), 1, axis=1)
            return Chain(start, transitions, self.lost.astype(float), by_number=True)
        transitions = np.eye(self.states, k=1)
        transitions[-1, -period] = 1.0
        acts = np.concatenate([np.zeros(self.begin + 1), np.roll(self.lost, -(self.begin % period))])
        return Chain(np.eye(self.states)[0], transitions, acts, by_number=True)


def pattern(period: int, lost: Iterable[int], begin: int = 0) -> PeriodicLosses:
    """Return the pattern in which these packet numbers of every ``period`` packets are lost.

    Raises:
        NotPredictableError: the period is too long.
    """
    if period > LONGEST_PATTERN:
        raise NotPredictableError(f"the loss pattern repeats only after {period} packets")
    flags = np.zeros(period, bool)
    flags[np.fromiter(lost, np.int64)] = True
    return PeriodicLosses(flags, begin)


def chance_chain(probability: float, correlation: float, action: str) -> Chain:
    """Return the chain of :mod:`netem.impairments.feature`, with its action.

    Raises:
        NotPredictableError: the correlation is too high.
    """
    if correlation == 0.0 or probability in (0.0, 1.0):
        certain = np.ones(1), np.ones((1, 1)), np.array([probability])
        return Chain(*certain, action)
    nodes, weights, acts = _nodes(probability, correlation)
    innovation = math.sqrt(1 - correlation**2)
    steps = (nodes - correlation * nodes[:, None]) / innovation
    transitions = stochastic(np.exp(-(steps**2) / 2) * weights)
    start = np.exp(-(nodes**2) / 2) * weights
    return Chain(start / start.sum(), transitions, acts, action)


def _nodes(probability: float, correlation: float) -> tuple[Array, Array, Array]:
    """Return Gauss nodes and weights on both sides of the latent process's threshold."""
    threshold = -core.noack_normal_score(probability)
    edge = 8.3  # no uniform number has a score beyond
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


def reachable_transitions(guarantee: LossGuarantee, most: int) -> TransitionTable:
    """Return the transitions between all states of a guarantee.

    Raises:
        NotPredictableError: there are more than ``most``.
    """
    if (transitions := transition_table(guarantee, most)) is None:
        raise NotPredictableError(
            f"impairments and guarantee together have more than {MOST_JOINT_STATES} states, "
            "too many to compute with"
        )
    return transitions


def pattern_rate(lost: NDArray[np.bool_], guarantee: LossGuarantee) -> float:
    """Return the loss rate of a periodic pattern, by following it until a state recurs.

    Raises:
        NotPredictableError: that takes too long.
    """
    automaton, state, losses = LossAutomaton(guarantee), np.zeros(1, np.int64), 0
    visits: dict[int, tuple[int, int]] = {}
    for period in range(_MOST_STEPS // len(lost) + 1):
        if int(state[0]) in visits:
            first, earlier_losses = visits[int(state[0])]
            return (losses - earlier_losses) / ((period - first) * len(lost))
        visits[int(state[0])] = period, losses
        for is_lost in lost.tolist():
            after_loss = automaton.after_loss(state) if is_lost else state
            if is_lost and after_loss[0] >= 0:
                state, losses = after_loss, losses + 1
            else:
                state = automaton.after_delivery(state)
    raise NotPredictableError("the losses repeat only after too many packets to compute with")


def transitions_by_outcome(
    transitions: Array, lost: Array, guarantee: LossGuarantee
) -> "tuple[csr_array[np.float64], csr_array[np.float64]]":
    """Return the joint chain's transitions with a loss, and those with a delivery, under a guarantee.

    The first n states have the state before the first packet of the guarantee's automaton.

    Args:
        transitions: (n, n) transition matrix.
        lost: (n,) probability in each state that the packet is lost, if it may be.
        guarantee: the guarantee.

    Raises:
        NotPredictableError: there are too many states, or scipy is not installed.
    """
    require_scipy()
    from scipy import sparse  # slow to import

    after_loss, after_delivery = reachable_transitions(guarantee, MOST_JOINT_STATES // len(transitions))
    count = len(after_loss)
    allowed = after_loss >= 0

    def to(targets: NDArray[np.int64], allows: NDArray[np.bool_]) -> "csr_array[np.float64]":
        places = np.flatnonzero(allows)
        shape = (count, count)
        return sparse.csr_array((np.ones(len(places)), (places, targets[places])), shape)

    losing = sparse.kron(to(after_loss, allowed), transitions * lost)
    delivering = sparse.kron(to(after_delivery, allowed), transitions * (1 - lost))
    forced = sparse.kron(to(after_delivery, ~allowed), transitions)
    return losing.tocsr(), (delivering + forced).tocsr()


def constrained_rate(start: Array, transitions: Array, lost: Array, guarantee: LossGuarantee) -> float:
    """Return the loss rate of a joint chain of n states.

    Args:
        start: (n,) distribution before the first packet.
        transitions: (n, n) transition matrix.
        lost: (n,) probability in each state that the packet is lost, if it may be.
        guarantee: the guarantee.

    Raises:
        NotPredictableError: there are too many states, or the rate depends on chance.
    """
    losing, delivering = transitions_by_outcome(transitions, lost, guarantee)
    at_start = np.zeros(losing.shape[0])
    at_start[: len(start)] = start
    distribution = _stationary((losing + delivering).tocsr(), at_start)
    return float((losing.T @ distribution).sum())


def _stationary(joint: "csr_array[np.float64]", start: Array) -> Array:
    """Return the stationary distribution of the states that remain possible."""
    from scipy.sparse import csgraph  # slow to import

    steps = csgraph.dijkstra(joint, indices=np.flatnonzero(start), unweighted=True, min_only=True)
    places = np.flatnonzero(np.isfinite(steps))
    part = joint[places][:, places]
    _, labels = csgraph.connected_components(part, connection="strong")
    sources, targets = part.nonzero()
    leaves = labels[sources] != labels[targets]
    closed = np.setdiff1d(labels, labels[sources[leaves]])
    if len(closed) > 1:
        raise NotPredictableError("the loss rate depends on what happens at the beginning")
    recurrent = np.flatnonzero(labels == closed[0])
    distribution = np.zeros(len(start))
    distribution[places[recurrent]] = _balance(part[recurrent][:, recurrent])
    return distribution


def _balance(transitions: "csr_array[np.float64]") -> Array:
    """Return the stationary distribution π = πP of an irreducible chain.

    With π = 1 for a likely state, the other equations are a regular, well-conditioned system. It is
    sparse: few states of the guarantee follow a state.
    """
    from scipy.sparse import eye_array, linalg  # slow to import

    count = transitions.shape[0]
    distribution: Array = np.ones(count)
    if count == 1:
        return distribution
    for _ in range(_WARM_UP):
        distribution = (distribution + transitions.T @ distribution) / 2
    unlikely = np.delete(np.arange(count), likely := int(np.argmax(distribution)))
    system = (eye_array(count) - transitions.T).tocsc()
    flow = transitions[[likely]].toarray()[0, unlikely]
    distribution[likely] = 1.0
    distribution[unlikely] = np.maximum(linalg.splu(system[unlikely][:, unlikely].tocsc()).solve(flow), 0.0)
    distribution /= distribution.sum()
    return distribution
