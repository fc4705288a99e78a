"""The graph of what may happen between two deliveries, under a guarantee about losses.

The nodes are the states of the guarantee's automaton just after a delivery, and the times at which
the sensor transmits relative to the controller's ticks. An edge is the time from a delivered update
to the next delivered one.
"""

from typing import NamedTuple

import numpy as np

from noack.core.errors import CallerError
from noack.impairments.loss_guarantee import LossAutomaton, LossGuarantee

MOST_EDGES = 5000


class EventTimes(NamedTuple):
    """The time between two transmissions, in steps: any number within these limits."""

    shortest: int = 1
    longest: int = 1


EVERY_STEP = EventTimes()


class Burst(NamedTuple):
    """Losses between two deliveries, as an edge of the graph."""

    source: int
    target: int
    slot: int
    """Number of the step of the first delivered update, modulo the number of slots."""
    losses: int
    steps: int
    """Time between the two deliveries."""

    def intervals(self, times: EventTimes) -> list[int]:
        """Return times between the transmissions, (losses + 1,), in steps; the longest first."""
        found, left = [], self.steps
        for further in range(self.losses, -1, -1):
            found.append(min(times.longest, left - further * times.shortest))
            left -= found[-1]
        return found


def bursts_of(
    guarantee: LossGuarantee, slots: int = 1, times: EventTimes = EVERY_STEP
) -> list[Burst]:
    """Return the graph of a guarantee between deliveries; node 0 is that of the first delivery.

    Different states of the automaton after which the same is allowed are one node.

    Of edges between the same nodes with the same time, there is the one with the fewest losses.

    Raises:
        CallerError: there are more than 5,000 edges.
    """
    automaton = LossAutomaton(guarantee)
    first = int(automaton.after_delivery(np.zeros(1, int))[0])
    numbers, pending = {(first, 0): 0}, [(first, 0)]
    found: dict[tuple[int, int, int], Burst] = {}
    while pending:
        state, slot = pending.pop()
        source, losses = numbers[state, slot], 0
        while state >= 0:
            after = int(automaton.after_delivery(np.array([state]))[0])
            sent = losses + 1
            for steps in range(sent * times.shortest, sent * times.longest + 1):
                target = (after, (slot + steps) % slots)
                if target not in numbers:
                    numbers[target] = len(numbers)
                    pending.append(target)
                burst = Burst(source, numbers[target], slot, losses, steps)
                found.setdefault((source, numbers[target], steps), burst)
            if len(found) > MOST_EDGES:
                raise CallerError(
                    f"network: {guarantee.meaning}: more than {MOST_EDGES:,} transitions; reduce "
                    "mansd, the windows of the constraints, or the number of measurements between "
                    "two events"
                )
            state, losses = int(automaton.after_loss(np.array([state]))[0]), sent
    return _merged(list(found.values()))


def _merged(bursts: list[Burst]) -> list[Burst]:
    """Return the graph with one node for all that have the same paths, the lowest of them.

    Nodes are divided as long as edges of one class differ in their losses, times or targets' class.
    """
    leaving: dict[int, list[Burst]] = {}
    for burst in bursts:
        leaving.setdefault(burst.source, []).append(burst)
    classes, count = dict.fromkeys(leaving, 0), 0
    while len(set(classes.values())) > count:
        count = len(set(classes.values()))
        seen = {
            node: frozenset((*one[2:], classes[one.target]) for one in ones)
            for node, ones in leaving.items()
        }
        numbers = {future: number for number, future in enumerate(dict.fromkeys(seen.values()))}
        classes = {node: numbers[future] for node, future in seen.items()}
    lowest: dict[int, int] = {}
    for node in sorted(classes):
        lowest.setdefault(classes[node], node)
    return [
        burst._replace(target=lowest[classes[burst.target]])
        for node in lowest.values() for burst in leaving[node]
    ]  # fmt: skip
