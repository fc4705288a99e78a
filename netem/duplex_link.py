"""Both directions of the network as one machine, if acknowledgements or actuations cross it, too.

The flows 0 to N − 1 of a run with N loops use the direction of the updates, the next N the
direction from the controller. The two are independent: each has its own settings, random streams
and guarantee.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

from netem.link_machine import Datagram, Link, link_name, link_of, update_link_of
from noack.config.parameter_changes import FixedMachine, ParameterChange
from noack.config.scenario import Scenario
from noack.protocol.machine_interface import BEGINNING, Machine, Notice, Record, Start

T = TypeVar("T", bound=Any)


class Duplex(FixedMachine):
    """The machine of a network with a direction from the controller.

    If the forward direction is a link with a schedule of changes, its settings may change.
    """

    def __init__(
        self,
        forward: Machine[Datagram],
        reverse: Machine[Datagram],
        *,
        first_number: int = 0,
        loops: int = 1,
    ) -> None:
        self._links = (forward, reverse)
        self._loops = loops
        self._inputs = first_number

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Accept a change of the forward direction; see :class:`netem.link_machine.Link`."""
        forward = self._links[0]
        if not isinstance(forward, Link):
            return super().announce(change, now_ns)
        return self._numbered(forward.announce(change, now_ns))

    def next_deadline_ns(self) -> int | None:
        """Time of the next departure in either direction; None: nothing is in flight."""
        due = (link.next_deadline_ns() for link in self._links)
        return min((t_ns for t_ns in due if t_ns is not None), default=None)

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Forward the datagram that is due; if one is due in each direction, the forward one."""
        next_ns = self.next_deadline_ns()
        link = next(link for link in self._links if link.next_deadline_ns() == next_ns)
        return self._numbered(link.on_timer(now_ns))

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Process a datagram; return it if it is neither lost nor delayed."""
        if not 0 <= message.flow < 2 * self._loops:
            raise ValueError(f"a network of two directions has no flow {message.flow}")
        if isinstance(forward := self._links[0], Link):
            forward.reach(now_ns)  # a change is due for both directions at the same datagram
        return self._numbered(self._links[message.flow // self._loops].handle(message, now_ns))

    def _numbered(self, outputs: Sequence[T]) -> list[T]:
        """Number the inputs of both directions in one sequence; an input produces one row."""
        number, self._inputs = self._inputs, self._inputs + 1
        return [
            output._replace(row=(number, *output.row[1:])) if isinstance(output, Record) else output
            for output in outputs
        ]


def network_of(
    resolved: Scenario,
    start: Start = BEGINNING,
    forward: Machine[Datagram] | None = None,
    loops: int = 1,
) -> Machine[Datagram]:
    """Return the network of a resolved scenario; ``forward`` replaces the link of the updates."""
    forward = update_link_of(resolved, start) if forward is None else forward
    _, *others = resolved.network.flows
    if not others:
        return forward
    settings, name = resolved.network.link_of(others[0]), link_name(others[0])
    reverse = link_of(settings, resolved.seeds.loss, name, start)
    return Duplex(forward, reverse, first_number=start.first_number, loops=loops)
