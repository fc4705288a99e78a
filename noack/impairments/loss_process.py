"""The losses of a link that nothing limits: a Markov chain that advances with every packet.

In the state s that it reaches with a packet, the packet is not effectively delivered with
probability ℓ(s). All probabilities here are those of the packets' numbers; when the packets are
sent does not matter, even if that depends on earlier losses.
"""

from dataclasses import dataclass

import numpy as np

from noack.impairments.guarantee_chain import moves_of
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_guarantee import LossGuarantee
from noack.impairments.loss_prediction import joint_chain
from noack.impairments.markov_chain import Array, NotPredictableError

_MOST_SQUARED = 600
"""States of chain and guarantee up to which powers of their matrix are computed."""
_MOST_STEPS = 20_000
_ROUNDING = 1e-12


@dataclass(frozen=True)
class LossProcess:
    """The random losses of a link's packets."""

    start: Array
    """(n,) distribution before the first packet."""
    moves: Array
    """(n, n) transition matrix."""
    lost: Array
    """(n,) probability of a loss in each state."""
    first_delivered: bool = True
    """Whether the first packet is delivered in any case."""

    @property
    def is_independent(self) -> bool:
        """Whether every packet is lost with the same probability, independently."""
        given = self._loss_given_state
        return bool(np.ptp(given) <= _ROUNDING)

    @property
    def largest_probability(self) -> float:
        """The largest probability that a packet is lost, given any outcomes before it."""
        return float(self._loss_given_state.max())

    def tails(self, count: int) -> tuple[Array, float]:
        """Bound the probability that a packet and the j − 1 packets before it are all lost.

        Returns:
            The bounds, (count,), for j = 1, 2, …; exact if the chain is stationary. And the largest
            probability, given any past, that the next ``count`` packets are all lost.
        """
        lost, weights, found = self.moves * self.lost, np.ones(len(self.start)), []
        stationary = np.abs(self.start @ self.moves - self.start).max() <= _ROUNDING
        for _ in range(count):
            weights = lost @ weights
            found.append(self.start @ weights if stationary else weights.max())
        return np.array(found), float(weights.max())

    def keeps(self, guarantee: LossGuarantee, packets: int) -> float:
        """Return the probability that the first packets keep a guarantee by chance.

        Raises:
            NotPredictableError: there are too many states or packets.
        """
        n = len(self.start)
        after_loss, after_delivery = moves_of(guarantee, _MOST_STEPS // n)
        allowed = after_loss >= 0
        lost, passed = self.moves * self.lost, self.moves * (1 - self.lost)
        at = np.zeros((len(after_loss), n))
        if self.first_delivered and packets > 0:
            at[after_delivery[0]] = self.start @ self.moves
            packets -= 1
        else:
            at[0] = self.start
        if at.size <= _MOST_SQUARED:
            states = np.arange(len(after_loss))
            matrix = np.zeros((len(states), n, len(states), n))
            matrix[states[allowed], :, after_loss[allowed]] += lost
            matrix[states, :, after_delivery] += passed
            power = np.linalg.matrix_power(matrix.reshape(at.size, at.size), packets)
            return float(min((at.ravel() @ power).sum(), 1.0))
        if packets > _MOST_STEPS:
            raise NotPredictableError(f"{packets} packets are too many to compute with")
        for _ in range(packets):
            following = np.zeros_like(at)
            np.add.at(following, after_delivery, at @ passed)
            np.add.at(following, after_loss[allowed], at[allowed] @ lost)
            at = following
        return float(min(at.sum(), 1.0))

    @property
    def _loss_given_state(self) -> Array:
        """The probability of a loss, given each state before it that can be reached; (k,)."""
        reached, before = self.start > 0, -1
        while before != (before := int(np.count_nonzero(reached))):
            reached = reached | (reached @ self.moves > 0)
        found: Array = (self.moves @ self.lost)[reached]
        return found


def loss_process(settings: LinkSettings) -> LossProcess:
    """Return the losses of a link's direction without its guarantee.

    Raises:
        NotPredictableError: they cannot be computed; the message is the reason.
    """
    delayed, reordered = False, False
    for one in settings.impairments:
        delayed, reordered = one.reorders(delayed, reordered)
        if one.prediction_note:
            raise NotPredictableError(f"the losses are known only {one.prediction_note}")
    if reordered:
        raise NotPredictableError("packets may arrive out of order, which counts as a loss")
    start, moves, lost = joint_chain(settings)
    return LossProcess(start, moves, lost, settings.first_delivered)
