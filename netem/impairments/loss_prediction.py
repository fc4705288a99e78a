"""The losses of a link, computed: their rate under a guarantee, and the process without one.

Each random feature is a Markov chain that advances with every packet. Together they are one chain
with transition matrix P; in each state, a packet is not effectively delivered with probability ℓ.
Let A = P diag(ℓ), B = P diag(1 − ℓ), m the cap, and v the distribution of the state at a
delivered packet. Then

* E D = v Σ_{k=1..m} A^k 1 is the expected number of losses before the next delivery, and
* v is stationary under Σ_{k<m} A^k B + A^m P, since the packet after m losses must pass.

The loss rate is E D/(E D + 1) (:func:`predict`). For independent losses it is p(1 − p^m)/(1 −
p^{m+1}). With windows or recovery, the states of the guarantee are part of the chain; see
:mod:`netem.impairments.markov_chain`.

:class:`LossProcess` is the same chain where nothing limits the losses. All probabilities are those
of the packets' numbers; when the packets are sent does not matter, even if that depends on earlier
losses.

A loss rate that is asked for (``loss 30% keep``) has no probability here: see
:mod:`netem.impairments.target_loss`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.guarantee.loss_guarantee import LossGuarantee
from netem.impairments.feature import PacketOrder
from netem.impairments.link_settings import USUAL_LIMIT, LinkSettings
from netem.impairments.markov_chain import (
    LONGEST_PATTERN,
    MOST_STATES,
    Array,
    Chain,
    NotPredictableError,
    PeriodicLosses,
    constrained_rate,
    pattern_rate,
    reachable_transitions,
    stochastic,
    transitions_by_outcome,
)

_MOST_SQUARED = 600
"""States of chain and guarantee up to which powers of their matrix are computed."""
_MOST_STEPS = 20_000
"""Most packets, and most states of chain and guarantee, that are followed one by one."""


class LossPrediction(NamedTuple):
    """A loss rate, or why there is none."""

    rate: float | None  # Expected share of a flow's packets that are dropped or corrupted
    note: str  # Why there is no rate, or the condition under which the rate holds; else empty


@lru_cache(maxsize=64)
def predict(settings: LinkSettings) -> LossPrediction:
    """Predict the loss rate of a direction; the settings must not name files.

    Packets that overflow a queue or the limit, or are delivered out of order, do not count, since
    their number depends on the arrival times.
    """
    impairments = settings.impairments
    try:
        parts = [
            part._replace(begin=0) if isinstance(part, PeriodicLosses) else part  # in the long run
            for impairment in impairments
            for part in impairment.chains()
        ]
        if settings.constraints:
            rate = _constrained_rate(parts, settings.guarantee)
        else:
            rate = _capped_rate(parts, settings.mansd)
    except NotPredictableError as error:
        return LossPrediction(None, str(error))
    order, notes = order_and_notes(settings)
    if settings.longest_burst != 0 and order.reordered:
        notes.append("not counting packets delivered out of order (stale)")
    return LossPrediction(rate, "; ".join(notes))


def order_and_notes(settings: LinkSettings) -> tuple[PacketOrder, list[str]]:
    """Return the order in which packets arrive, and the conditions under which a rate holds."""
    order, notes = PacketOrder(), list[str]()
    for impairment in settings.impairments:
        order = impairment.order_after(order)
        notes.append(impairment.prediction_note)
    if order.delayed and settings.limit < USUAL_LIMIT:
        notes.append(
            f"as long as no more than {settings.limit} "
            f"{'packet is' if settings.limit == 1 else 'packets are'} delayed at once"
        )
    return order, [note for note in dict.fromkeys(notes) if note]


def joint_chain(settings: LinkSettings) -> tuple[Array, Array, Array]:
    """Return the chain of all impairments: start (n,), matrix (n, n), probability of loss (n,).

    The settings must not name files.

    Raises:
        NotPredictableError: there is no such chain; the message is the reason.
    """
    return _joint_chain([part for impairment in settings.impairments for part in impairment.chains()])


def _constrained_rate(parts: Sequence[Chain | PeriodicLosses], guarantee: LossGuarantee) -> float:
    patterns = [part.lost for part in parts if isinstance(part, PeriodicLosses)]
    if len(patterns) == len(parts):
        return pattern_rate(_lost_by_any(patterns), guarantee)
    return constrained_rate(*_joint_chain(parts), guarantee)


def _capped_rate(parts: Sequence[Chain | PeriodicLosses], mansd: int | None) -> float:
    patterns = [part for part in parts if isinstance(part, PeriodicLosses)]
    if len(patterns) == len(parts):
        return _pattern_rate([part.lost for part in patterns], mansd)
    start, transitions, ineffective = _joint_chain(parts)
    if mansd is None:
        return float(_stationary(start, transitions) @ ineffective)
    lost, passed = transitions * ineffective, transitions * (1 - ineffective)
    total, power = _geometric(lost, mansd)
    at_delivery = _stationary(start, stochastic(total @ passed + power @ transitions))
    burst = float((at_delivery @ lost @ total).sum())
    return burst / (burst + 1)


def _pattern_rate(patterns: Sequence[NDArray[np.bool_]], mansd: int | None) -> float:
    """Return the loss rate of several patterns combined, counted over their common period."""
    lost = _lost_by_any(patterns)
    period = len(lost)
    if mansd is None:
        return float(lost.mean())
    if lost.all():
        return mansd / (mansd + 1)
    passed = np.flatnonzero(~lost)
    bursts = np.diff(passed, append=passed[0] + period) - 1
    return float((bursts - bursts // (mansd + 1)).sum() / period)


def _lost_by_any(patterns: Sequence[NDArray[np.bool_]]) -> NDArray[np.bool_]:
    period = math.lcm(*map(len, patterns))
    if period > LONGEST_PATTERN:
        raise NotPredictableError(f"the loss patterns repeat together only after {period} packets")
    lost = np.zeros(period, bool)
    for pattern in patterns:
        lost |= np.resize(pattern, period)
    return lost


def _joint_chain(parts: Sequence[Chain | PeriodicLosses]) -> tuple[Array, Array, Array]:
    """Return the joint chain: start, matrix, probability of no effective delivery."""
    states = math.prod(part.states if isinstance(part, PeriodicLosses) else len(part.start) for part in parts)
    if states > MOST_STATES:
        raise NotPredictableError(f"together the impairments have {states} states, too many to compute with")
    start: Array = np.ones(1)
    transitions: Array = np.ones((1, 1))
    chains = [part.chain if isinstance(part, PeriodicLosses) else part for part in parts]
    actions: list[_Action] = []
    for chain in chains:
        n, size_so_far = len(chain.start), len(start)
        start = np.kron(start, chain.start).astype(np.float64)
        transitions = np.kron(transitions, chain.transitions).astype(np.float64)
        actions = [
            _Action(before.kind, *(np.repeat(shares, n) for shares in before[1:])) for before in actions
        ]
        shares = (np.tile(acts, size_so_far) for acts in (chain.acts, chain.acts_on_duplicate))
        actions.append(_Action(chain.action, *shares))
    return start, transitions, _ineffective(actions, states)


class _Action(NamedTuple):
    """What an impairment does to a packet, with a probability in each of n states of all impairments."""

    kind: str  # ``lose``, ``corrupt`` or ``duplicate``
    on_packet: Array  # (n,)
    on_duplicate: Array  # (n,)


_LOST, _INTACT, _CORRUPT = range(3)


def _ineffective(actions: Sequence[_Action], states: int) -> Array:
    """Return the probability (states,) that no intact copy of a packet leaves.

    There are at most two copies, the packet and its duplicate. A duplicate that was not made counts
    as lost.
    """
    shares = np.zeros((3, 3, states))
    """Axis 0: the packet is lost, intact or corrupt. Axis 1: its duplicate is. Axis 2: the state."""
    shares[_INTACT, _LOST] = 1.0
    for action in actions:
        if action.kind == "duplicate":
            for condition in (_INTACT, _CORRUPT):
                for single in ((condition, _LOST), (_LOST, condition)):
                    made = shares[single] * action.on_packet
                    shares[single] -= made
                    shares[condition, condition] += made
            continue
        changed_to = _LOST if action.kind == "lose" else _CORRUPT
        for of_copy, acts in ((shares, action.on_packet), (shares.swapaxes(0, 1), action.on_duplicate)):
            for condition in (_INTACT, _CORRUPT):
                if condition != changed_to:
                    changed = of_copy[condition] * acts
                    of_copy[condition] -= changed
                    of_copy[changed_to] += changed
    ineffective: Array = 1 - shares[_INTACT].sum(axis=0) - shares[[_LOST, _CORRUPT], _INTACT].sum(axis=0)
    return ineffective


def _geometric(matrix: Array, terms: int) -> tuple[Array, Array]:
    """Return Σ_{k<terms} Mᵏ and M^terms, by doubling."""
    total, power = np.zeros_like(matrix), np.eye(len(matrix))
    for bit in bin(terms)[2:]:
        total, power = total + power @ total, power @ power
        if bit == "1":
            total, power = total + power, power @ matrix
    return total, power


def _stationary(start: Array, transitions: Array) -> Array:
    """Return the mean distribution over the states, by doubling over 2⁶⁴ steps.

    The mean exists for periodic chains, too.
    """
    mean, power = np.eye(len(start)), transitions
    for _ in range(64):
        mean, power = (mean + power @ mean) / 2, stochastic(power @ power)
    distribution: Array = start @ mean
    return distribution


@dataclass(frozen=True)
class LossProcess:
    """The random losses of a link's packets."""

    start: Array  # (n,) distribution before the first packet
    transitions: Array  # (n, n) transition matrix
    lost: Array  # (n,) probability of a loss in each state
    first_delivered: bool = True  # Whether the first packet is delivered in any case

    def outcomes(self, guarantee: LossGuarantee) -> "OutcomeChain":
        """Return the chain of the packets' outcomes under a guarantee, with its reachable states.

        Raises:
            NotPredictableError: there are too many states.
        """
        n, most = len(self.start), _MOST_SQUARED // len(self.start)
        after_delivery = reachable_transitions(guarantee, most).after_delivery
        losing, delivering = transitions_by_outcome(self.transitions, self.lost, guarantee)
        count = len(after_delivery) * n
        # The last state is that before the first packet.
        lost, delivered = np.zeros((count + 1, count + 1)), np.zeros((count + 1, count + 1))
        lost[:count, :count], delivered[:count, :count] = losing.toarray(), delivering.toarray()
        if self.first_delivered:
            first = after_delivery[0] * n
            delivered[count, first : first + n] = self.start @ self.transitions
        else:
            lost[count], delivered[count] = self.start @ lost[:n], self.start @ delivered[:n]
        reached = np.arange(count + 1) == count
        while not reached.all():
            further = reached | ((lost + delivered)[reached].sum(axis=0) > 0)
            if (further == reached).all():
                break
            reached = further
        reachable = np.ix_(reached, reached)
        return OutcomeChain(lost[reachable], delivered[reachable])

    def mean_burst(self) -> float | None:
        """Return the mean number of consecutive losses; None: losses never begin, or never end."""
        stationary = _stationary(self.start, self.transitions)
        lost = float(stationary @ self.lost)
        begins = float((stationary * (1 - self.lost)) @ (self.transitions @ self.lost))
        return lost / begins if begins > 0 else None

    def keeps(self, guarantee: LossGuarantee, packets: int) -> float:
        """Return the probability that the first packets keep a guarantee by chance.

        Raises:
            NotPredictableError: there are too many states or packets.
        """
        n = len(self.start)
        after_loss, after_delivery = reachable_transitions(guarantee, _MOST_STEPS // n)
        allowed = after_loss >= 0
        lost, passed = self.transitions * self.lost, self.transitions * (1 - self.lost)
        weights = np.zeros((len(after_loss), n))
        if self.first_delivered and packets > 0:
            weights[after_delivery[0]] = self.start @ self.transitions
            packets -= 1
        else:
            weights[0] = self.start
        if weights.size <= _MOST_SQUARED:
            states = np.arange(len(after_loss))
            matrix = np.zeros((len(states), n, len(states), n))
            matrix[states[allowed], :, after_loss[allowed]] += lost
            matrix[states, :, after_delivery] += passed
            power = np.linalg.matrix_power(matrix.reshape(weights.size, weights.size), packets)
            return float(min((weights.ravel() @ power).sum(), 1.0))
        if packets > _MOST_STEPS:
            raise NotPredictableError(f"{packets} packets are too many to compute with")
        for _ in range(packets):
            following = np.zeros_like(weights)
            np.add.at(following, after_delivery, weights @ passed)
            np.add.at(following, after_loss[allowed], weights[allowed] @ lost)
            weights = following
        return float(min(weights.sum(), 1.0))


class OutcomeChain(NamedTuple):
    """A Markov chain with n states that advances with every packet, and the packets' outcomes.

    The last state is that before the first packet.
    """

    lost: Array  # (n, n) Probabilities of a step whose packet is lost
    delivered: Array  # (n, n) The same of a delivery; both together are a stochastic matrix

    @property
    def mean_burst(self) -> float | None:
        """The mean number of consecutive losses; None: losses never begin, or never end."""
        distribution = self.distribution()
        lost, begins = (distribution @ self.lost).sum(), (distribution @ self.delivered @ self.lost).sum()
        return float(lost / begins) if begins > 0 else None

    @property
    def variance(self) -> float:
        """The variance of the number of losses among many packets, divided by their number."""
        transitions, distribution = self.lost + self.delivered, self.distribution()
        rate = float((distribution @ self.lost).sum())
        count = len(distribution)
        # The correlation of a loss with all later ones, by the fundamental matrix (Kemeny and Snell).
        fundamental = np.linalg.pinv(np.eye(count) - transitions + np.outer(np.ones(count), distribution))
        deviation = self.lost.sum(axis=1) - rate
        after_loss = distribution @ self.lost - rate * distribution
        return float(max(rate * (1 - rate) + 2 * after_loss @ fundamental @ deviation, 0.0))

    def after_pause(self) -> "OutcomeChain":
        """Return the chain of a sensor that does not transmit at its first time, as if lost."""
        lost, delivered = np.pad(self.lost, (0, 1)), np.pad(self.delivered, (0, 1))
        lost[-1, -2] = 1.0
        return OutcomeChain(lost, delivered)

    def distribution(self, spacing: int = 1) -> Array:
        """Return the mean distribution before the packets 0, ``spacing``, 2 ``spacing``, …, (n,)."""
        transitions = np.linalg.matrix_power(self.lost + self.delivered, spacing)
        return _stationary(np.eye(len(transitions))[-1], transitions)
