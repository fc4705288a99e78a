"""Whether one guarantee implies another: every pattern of losses that it allows, the other allows.

The states of a guarantee that some pattern reaches are listed once. A rule of the other guarantee
is broken from one of these states on, or never:

* a rule on windows, if the largest number of losses in the next packets exceeds the limit. With
  V_k(s), the most losses in k packets from state s on, V_k(s) is the maximum of V_{k−1} after a
  delivery and 1 + V_{k−1} after a loss, if s allows one;
* a rule on the deliveries between bursts, if a loss, too few deliveries and a loss are allowed.

So the other guarantee needs no automaton, and its windows may be long.
"""

import numpy as np
from numpy.typing import NDArray

from noack.core.errors import CallerError
from noack.impairments.loss_guarantee import (
    DeliveriesBetweenBursts,
    Indices,
    LongestBurst,
    LossAutomaton,
    LossesInWindow,
    LossGuarantee,
    LossRule,
)

_MOST_STATES, _MOST_STEPS = 200_000, 200_000_000
Pattern = tuple[bool, ...]
"""Whether each update is delivered, from the first one on."""


def find_pattern_beyond(guarantee: LossGuarantee, other: LossGuarantee) -> Pattern | None:
    """Return a shortest pattern that a guarantee allows and another one forbids.

    None: there is none, so the guarantee implies the other one.

    Raises:
        CallerError: the guarantee has too many states.
    """
    states = _States(guarantee)
    found = [states.pattern_against(rule) for rule in other.rules]
    return min((one for one in found if one is not None), key=len, default=None)


class _States:
    """The states of a guarantee in the order of the shortest patterns that reach them."""

    def __init__(self, guarantee: LossGuarantee) -> None:
        automaton, begin, count = LossAutomaton(guarantee), 0, 1
        moves, origins, depths = list[Indices](), [np.zeros((1, 2), int)], [np.zeros(1, int)]
        self._meaning = guarantee.meaning
        while begin < count:
            states = np.arange(begin, count)
            both = np.array([automaton.after_loss(states), automaton.after_delivery(states)])
            reached, places = np.unique(both, return_index=True)
            kinds, numbers = np.divmod(places[reached >= count], len(states))
            moves.append(both)
            origins.append(np.column_stack([begin + numbers, kinds]))
            depths.append(np.full(len(numbers), len(depths)))
            begin, count = count, count + len(numbers)
            self._require(count < _MOST_STATES)
        self._after_loss, self._after_delivery = np.concatenate(moves, axis=1)
        self._origins = np.concatenate(origins)
        """The state before each state, and 1 if the update between was delivered, else 0."""
        self._depths = np.concatenate(depths)

    def _require(self, is_small: bool) -> None:
        if not is_small:
            raise CallerError(f"{self._meaning}: too many states to compare; use shorter windows")

    def pattern_against(self, rule: LossRule) -> Pattern | None:
        """Return a shortest pattern that breaks a rule; None if the rule is implied."""
        if isinstance(rule, LongestBurst):
            return self._with_losses(rule.limit, rule.limit + 1)
        if isinstance(rule, LossesInWindow):
            return self._with_losses(rule.limit, rule.window)
        if isinstance(rule, DeliveriesBetweenBursts):
            return self._with_near_bursts(rule.deliveries)
        raise TypeError(rule)

    def _with_losses(self, most: int, window: int) -> Pattern | None:
        """Return a shortest pattern with more losses in a window, which may be cut short."""
        if most >= window:
            return None
        self._require(len(self._depths) * window < _MOST_STEPS)
        largest = np.zeros(len(self._depths), int)
        is_loss: list[NDArray[np.bool_]] = []
        best: tuple[int, int, int] | None = None  # length, state, packets
        for packets in range(1, window + 1):
            lost = np.where(self._after_loss >= 0, 1 + largest[self._after_loss], -1)
            delivered = largest[self._after_delivery]
            is_loss.append(lost >= delivered)
            largest = np.maximum(lost, delivered)
            for state in np.flatnonzero(largest > most)[:1].tolist():  # the first is the nearest
                length = int(self._depths[state]) + packets
                best = min(best or (length, state, packets), (length, state, packets))
        if best is None:
            return None
        _, state, packets = best
        pattern = [*self._to(state)]
        for losses in is_loss[packets - 1 :: -1]:
            pattern.append(not losses[state])
            state = int((self._after_loss if losses[state] else self._after_delivery)[state])
        return tuple(pattern)

    def _with_near_bursts(self, deliveries: int) -> Pattern | None:
        """Return a shortest pattern with fewer deliveries between two bursts of losses."""
        found: list[Pattern] = []
        states = np.flatnonzero(self._after_loss >= 0)
        after = self._after_loss[states]
        for between in range(1, deliveries):
            after = self._after_delivery[after]
            found += [
                (*self._to(state), False, *[True] * between, False)
                for state in states[self._after_loss[after] >= 0][:1].tolist()
            ]
        return min(found, key=len, default=None)

    def _to(self, state: int) -> Pattern:
        """Return a shortest pattern that reaches a state."""
        pattern: list[bool] = []
        while state:
            state, delivered = self._origins[state].tolist()
            pattern.append(bool(delivered))
        return tuple(reversed(pattern))
