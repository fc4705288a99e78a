"""The guarantee of a network, as rules on the outcomes (delivered or lost) of successive packets.

A rule is a counter: from its state and the next outcome follow its next state and a value. The
outcome keeps the rule if the value is at most the rule's limit; a delivery always does. These
counters are the one definition of the guarantee for the checks of records, for the controller and
for the adversary; ``native/network/guarantee.c`` enforces them in the emulator. At the end, from
:func:`transition_table` on: whether one guarantee implies another.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.errors import CallerError

StateIndices = NDArray[np.int64]
GuaranteeState = tuple[int, ...]
"""The state of each rule."""

_FORBIDDEN, _UNKNOWN = -1, -2
"""In place of the number of a next state: the outcome is not allowed, or has not been followed yet."""


def outcome_letters(delivered: Iterable[bool]) -> str:
    """Return the outcomes of successive packets as text: ``D`` delivered, ``L`` lost."""
    return "".join("D" if outcome else "L" for outcome in delivered)


class LossRule(ABC):
    """One rule of a guarantee, as a counter; states and values are integers."""

    limit: int
    """The largest value that is allowed."""

    @property
    def start(self) -> int:
        """The state before the first packet."""
        return 0

    @property
    @abstractmethod
    def name(self) -> str:
        """Short name, in the words of the settings."""

    @property
    @abstractmethod
    def meaning(self) -> str:
        """The rule as part of a sentence."""

    @abstractmethod
    def after(self, state: int, lost: bool) -> tuple[int, int]:
        """Return the state after an outcome, and the value that is compared with the limit."""

    @abstractmethod
    def violation(self, value: float) -> str:
        """Return how a value violates the rule, as part of a sentence."""


@dataclass(frozen=True)
class LongestBurst(LossRule):
    """At most ``limit`` consecutive losses; the state is the number of consecutive losses."""

    limit: int
    name = "dropouts"

    @property
    def meaning(self) -> str:
        return f"at most {self.limit} lost in a row"

    def after(self, state: int, lost: bool) -> tuple[int, int]:
        count = state + 1 if lost else 0
        return count, count

    def violation(self, value: float) -> str:
        lost = "1 update" if value == 1 else f"{value:.0f} consecutive updates"
        return f"{lost} lost, {self.limit} allowed"


@dataclass(frozen=True)
class LossesInWindow(LossRule):
    """At most ``limit`` losses in ``window`` consecutive packets.

    The state has one bit for each of the last ``window`` − 1 packets: 1 if it was lost.
    """

    limit: int
    window: int

    @property
    def name(self) -> str:
        return f"atmost {self.limit} in {self.window}"

    @property
    def meaning(self) -> str:
        losses = "1 loss" if self.limit == 1 else f"{self.limit} losses"
        return f"at most {losses} in {self.window} consecutive packets"

    def after(self, state: int, lost: bool) -> tuple[int, int]:
        recent = state << 1 | lost
        return recent & ((1 << (self.window - 1)) - 1), recent.bit_count()

    def violation(self, value: float) -> str:
        return f"{value:.0f} of {self.window} consecutive updates lost, {self.limit} allowed"


@dataclass(frozen=True)
class DeliveriesBetweenBursts(LossRule):
    """At least ``deliveries`` consecutive deliveries between two bursts of losses.

    The state is the number of deliveries since the last loss, up to ``deliveries``; the value is
    the number of deliveries that were too few.
    """

    deliveries: int
    limit = 0

    @property
    def start(self) -> int:
        return self.deliveries

    @property
    def name(self) -> str:
        return f"recover {self.deliveries}"

    @property
    def meaning(self) -> str:
        count = "1 delivery" if self.deliveries == 1 else f"{self.deliveries} consecutive deliveries"
        return f"at least {count} between two bursts of losses"

    def after(self, state: int, lost: bool) -> tuple[int, int]:
        if not lost:
            return min(state + 1, self.deliveries), 0
        return 0, self.deliveries - state if state else 0

    def violation(self, value: float) -> str:
        least = self.deliveries
        return f"only {least - value:.0f} delivered between two bursts, at least {least} required"


class WindowBound(NamedTuple):
    """At most ``losses`` losses in ``packets`` consecutive packets."""

    losses: int
    packets: int


@dataclass(frozen=True)
class LossGuarantee:
    """All rules that a network keeps; without any, every packet may be lost."""

    rules: tuple[LossRule, ...] = ()

    @property
    def start(self) -> GuaranteeState:
        """The state before the first packet."""
        return tuple(rule.start for rule in self.rules)

    def after(self, state: GuaranteeState, *, lost: bool) -> GuaranteeState | None:
        """Return the state after an outcome; None: it is not allowed."""
        following = []
        for rule, rule_state in zip(self.rules, state, strict=True):
            next_state, value = rule.after(rule_state, lost)
            if value > rule.limit:
                return None
            following.append(next_state)
        return tuple(following)

    @property
    def uncapped(self) -> "LossGuarantee":
        """The rules besides the maximum number of consecutive losses."""
        return LossGuarantee(tuple(rule for rule in self.rules if not isinstance(rule, LongestBurst)))

    def capped(self, losses: int) -> "LossGuarantee":
        """Return the guarantee with another maximum number of consecutive losses."""
        return LossGuarantee((LongestBurst(losses), *self.uncapped.rules))

    @property
    def longest_burst(self) -> int | None:
        """The largest number of consecutive losses; None without a limit."""
        bursts = [
            rule.limit
            for rule in self.rules
            if isinstance(rule, LongestBurst)
            or (isinstance(rule, LossesInWindow) and rule.limit < rule.window)
        ]
        return min(bursts, default=None)

    @property
    def windows(self) -> tuple[WindowBound, ...]:
        """Bounds of the number of losses in windows; each follows from the rules.

        With at most b consecutive losses and h deliveries between bursts, b + h packets contain one
        burst, or parts of two with h deliveries between them: at most b losses.
        """
        burst = self.longest_burst
        if burst is None:
            return ()
        windows = [WindowBound(burst, burst + 1)]
        for rule in self.rules:
            if isinstance(rule, LossesInWindow):
                windows.append(WindowBound(rule.limit, rule.window))
            elif isinstance(rule, DeliveriesBetweenBursts):
                windows.append(WindowBound(burst, burst + rule.deliveries))
        return tuple(windows)

    @property
    def meaning(self) -> str:
        """All rules, as part of a sentence."""
        return ", ".join(rule.meaning for rule in self.rules) or "any number of losses"


class LossHistory:
    """Follows the outcomes of successive packets and finds violated rules."""

    def __init__(self, rules: Iterable[LossRule]) -> None:
        self._rules = tuple(rules)
        self._states = [rule.start for rule in self._rules]

    def add(self, lost: bool) -> list[tuple[LossRule, int]]:
        """Add an outcome; return the rules that it violates, each with its value."""
        violated = []
        for i, rule in enumerate(self._rules):
            self._states[i], value = rule.after(self._states[i], lost)
            if value > rule.limit:
                violated.append((rule, value))
        return violated


class LossAutomaton:
    """The states of a guarantee, numbered from 0 (the start) as they are reached.

    It follows many sequences of outcomes at once.
    """

    def __init__(self, guarantee: LossGuarantee) -> None:
        self._guarantee = guarantee
        self._states = [guarantee.start]
        self._numbers = {guarantee.start: 0}
        self._next: StateIndices = np.full((1, 2), _UNKNOWN)

    def after_loss(self, states: StateIndices) -> StateIndices:
        """Return the states after the loss of the next packet; −1 where it is not allowed."""
        return self._after(states, 1)

    def after_delivery(self, states: StateIndices) -> StateIndices:
        """Return the states after the delivery of the next packet."""
        return self._after(states, 0)

    def _after(self, states: StateIndices, lost: int) -> StateIndices:
        following: StateIndices = self._next[states, lost]
        if (unknown := following == _UNKNOWN).any():
            for state in np.unique(states[unknown]).tolist():
                self._next[state, lost] = self._number(self._states[state], bool(lost))
            following = self._next[states, lost]
        return following

    def _number(self, state: GuaranteeState, lost: bool) -> int:
        """Return the number of the state after an outcome; −1 if it is not allowed."""
        key = self._guarantee.after(state, lost=lost)
        if key is None:
            return _FORBIDDEN
        if key not in self._numbers:
            self._numbers[key] = len(self._states)
            self._states.append(key)
            if len(self._states) > len(self._next):
                added_rows = np.full((len(self._next), 2), _UNKNOWN)
                self._next = np.concatenate([self._next, added_rows])
        return self._numbers[key]


class TransitionTable(NamedTuple):
    """The a states of a guarantee; state 0 is that before the first packet."""

    after_loss: StateIndices  # (a,) −1: a loss is not allowed
    after_delivery: StateIndices  # (a,)


@lru_cache(maxsize=4)
def transition_table(guarantee: LossGuarantee, most: int) -> TransitionTable | None:
    """Return all states of a guarantee, the nearest ones first; None: there are more than ``most``."""
    automaton = LossAutomaton(guarantee)
    count, lost, delivered = 1, list[int](), list[int]()
    while len(lost) < count <= most:
        states = np.arange(len(lost), count)
        after_loss, after_delivery = automaton.after_loss(states), automaton.after_delivery(states)
        lost += after_loss.tolist()
        delivered += after_delivery.tolist()
        count = max(count, 1 + int(after_loss.max()), 1 + int(after_delivery.max()))
    return TransitionTable(np.array(lost), np.array(delivered)) if count <= most else None


_MOST_STATES, _MOST_STEPS = 200_000, 200_000_000
"""Limits of a comparison: of the states of a guarantee, and of states times packets of a window."""
OutcomePattern = tuple[bool, ...]
"""Whether each update is delivered, from the first one on."""


def find_counterexample(guarantee: LossGuarantee, implied: LossGuarantee) -> OutcomePattern | None:
    """Return a shortest pattern that a guarantee allows and another one forbids.

    None: there is none, so the guarantee implies the other one. A rule of the other guarantee is
    broken from one of the states of the guarantee on, or never:

    * a rule on windows, if the largest number of losses in the next packets exceeds the limit. With
      V_k(s), the most losses in k packets from state s on, V_k(s) is the maximum of V_{k−1} after a
      delivery and 1 + V_{k−1} after a loss, if s allows one;
    * a rule on the deliveries between bursts, if a loss, too few deliveries and a loss are allowed.

    So the other guarantee needs no automaton, and its windows may be long.

    Raises:
        CallerError: the guarantee has too many states.
    """
    shortest = _ShortestPatterns(guarantee)
    patterns = [shortest.pattern_against(rule) for rule in implied.rules]
    return min((pattern for pattern in patterns if pattern is not None), key=len, default=None)


class _ShortestPatterns:
    """The states of a guarantee in the order of the shortest patterns that reach them."""

    def __init__(self, guarantee: LossGuarantee) -> None:
        self._meaning = guarantee.meaning
        table = transition_table(guarantee, _MOST_STATES)
        if table is None:
            raise self._too_many()
        self._after_loss, self._after_delivery = table
        reached, places = np.unique(np.column_stack(table), return_index=True)
        self._origins = np.zeros((len(table.after_loss), 2), int)
        """The state before each state, and 1 if the update between was delivered, else 0."""
        self._origins[reached[reached > 0]] = np.column_stack(np.divmod(places[reached > 0], 2))
        self._depths = np.zeros(len(self._origins), int)
        for state, (previous, _) in enumerate(self._origins[1:].tolist(), 1):
            self._depths[state] = self._depths[previous] + 1

    def _too_many(self) -> CallerError:
        return CallerError(f"{self._meaning}: too many states to compare; use shorter windows")

    def pattern_against(self, rule: LossRule) -> OutcomePattern | None:
        """Return a shortest pattern that breaks a rule; None if the rule is implied."""
        if isinstance(rule, LongestBurst):
            return self._with_losses(rule.limit, rule.limit + 1)
        if isinstance(rule, LossesInWindow):
            return self._with_losses(rule.limit, rule.window)
        if isinstance(rule, DeliveriesBetweenBursts):
            return self._with_near_bursts(rule.deliveries)
        raise TypeError(rule)

    def _with_losses(self, most: int, window: int) -> OutcomePattern | None:
        """Return a shortest pattern with more losses in a window, which may be cut short."""
        if most >= window:
            return None
        if len(self._depths) * window >= _MOST_STEPS:
            raise self._too_many()
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
        pattern = [*self._path_to(state)]
        for losses in is_loss[packets - 1 :: -1]:
            pattern.append(not losses[state])
            state = int((self._after_loss if losses[state] else self._after_delivery)[state])
        return tuple(pattern)

    def _with_near_bursts(self, deliveries: int) -> OutcomePattern | None:
        """Return a shortest pattern with fewer deliveries between two bursts of losses."""
        patterns: list[OutcomePattern] = []
        states = np.flatnonzero(self._after_loss >= 0)
        reached = self._after_loss[states]
        for between in range(1, deliveries):
            reached = self._after_delivery[reached]
            patterns += [
                (*self._path_to(state), False, *[True] * between, False)
                for state in states[self._after_loss[reached] >= 0][:1].tolist()
            ]
        return min(patterns, key=len, default=None)

    def _path_to(self, state: int) -> OutcomePattern:
        """Return a shortest pattern that reaches a state."""
        pattern: list[bool] = []
        while state:
            state, delivered = self._origins[state].tolist()
            pattern.append(bool(delivered))
        return tuple(reversed(pattern))
