"""The largest delay of a loop's datagrams on a link that chooses, when it is free, what it sends.

docs/derivations.md, "The delay on a link", has the derivation and the names. With priorities this
is the response-time analysis of Davis, Burns, Bril and Lukkien (Controller Area Network
schedulability analysis: refuted, revisited and revised, Real-Time Systems 35, 2007); with deadlines
that of George, Rivierre and Spuri (Preemptive and non-preemptive real-time uniprocessor scheduling,
INRIA, RR-2966, 1996), with a whole c_j as blocking time: of two datagrams that arrive at the same
time at a free link, the one that is decided first is sent.
"""

import math
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import NamedTuple

_MOST_ARRIVALS = 20_000
"""Maximum number of arrivals in a busy period that are examined."""


class Sender(NamedTuple):
    """A loop on the link."""

    least_ns: int
    """d: the least time between two of its datagrams."""
    sent_ns: int
    """c: the time to send one."""
    after_ns: float = 0.0
    """δ: how long after a datagram one of this loop may arrive, to be sent before it."""


def response_ns(sender: Sender, other_senders: Mapping[Sender, int]) -> float:
    """Return the largest delay in ns of a loop's datagrams; infinite: no bound is known.

    Args:
        sender: the loop.
        other_senders: how many other loops of each kind there are.
    """
    interfering = [(*kind, count) for kind, count in other_senders.items() if kind.after_ns > -math.inf]
    together = [(sender.least_ns, sender.sent_ns), *((d, c * count) for d, c, _, count in interfering)]
    if sum(Fraction(c, d) for d, c in together) >= 1:
        return math.inf
    longest_ns = max((kind.sent_ns for kind in other_senders), default=0)
    busy_ns = _least(lambda t: longest_ns + sum(-(-t // d) * c for d, c in together))
    begins = [(sender.least_ns, 0)]
    begins += [(d, int(delta)) for d, _, delta, _ in interfering if delta < math.inf]
    if sum((busy_ns + abs(delta)) // d + 1 for d, delta in begins) > _MOST_ARRIVALS:
        return math.inf
    arrivals_ns = {a for d, delta in begins for a in range(max(-delta, -delta % d), busy_ns, d)}
    return max(_delay_ns(a, sender, other_senders) for a in arrivals_ns)


def _delay_ns(a: int, sender: Sender, other_senders: Mapping[Sender, int]) -> int:
    """Return the largest delay of a datagram that arrives at a."""
    blocking_ns = max((kind.sent_ns for kind in other_senders if a + kind.after_ns < 0), default=0)
    earlier_ns = blocking_ns + a // sender.least_ns * sender.sent_ns
    kinds = [(*kind, count) for kind, count in other_senders.items() if a + kind.after_ns >= 0]

    def begin_ns(w: int) -> int:
        return earlier_ns + sum(count * c * (1 + int(min(w, a + delta)) // d) for d, c, delta, count in kinds)

    return _least(begin_ns) + sender.sent_ns - a


def _least(step: Callable[[int], int]) -> int:
    """Return the least fixed point, above 0 if there is one, of a function that does not fall."""
    value, following = 0, step(1)
    while following > value:
        value, following = following, step(following)
    return value
