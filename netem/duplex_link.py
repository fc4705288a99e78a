"""Both directions of a link as one machine, for the loop that acknowledges its updates.

Flow 0 takes the way forward, flow 1 the way back. Neither direction knows of the other: settings,
random streams and guarantees are each one's own.
"""

from collections.abc import Sequence

from netem.link_machine import Datagram, link_of, update_link_of
from noack.config.parameter_changes import FixedMachine
from noack.config.scenario import Scenario
from noack.protocol.machine_interface import BEGINNING, Machine, Notice, Record, Start
from noack.protocol.record_tables import ACKNOWLEDGEMENTS, UPDATES

ACKNOWLEDGEMENT_LINK = "acknowledgement"
"""Name of the link from controller to sensor; part of its random streams' names."""


class Duplex(FixedMachine):
    """The machine of a network with a way back.

    Args:
        forward: takes the datagrams of flow 0.
        back: takes those of flow 1.
        first_number: of its inputs.
    """

    def __init__(
        self, forward: Machine[Datagram], back: Machine[Datagram], *, first_number: int = 0
    ) -> None:
        self._ways = {UPDATES: forward, ACKNOWLEDGEMENTS: back}
        self._inputs = first_number

    def next_deadline_ns(self) -> int | None:
        """When the next datagram leaves, in whichever direction."""
        due = (way.next_deadline_ns() for way in self._ways.values())
        return min((t_ns for t_ns in due if t_ns is not None), default=None)

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Let the datagram out that is due; of two, the one that goes forward."""
        next_ns = self.next_deadline_ns()
        way = next(way for way in self._ways.values() if way.next_deadline_ns() == next_ns)
        return self._numbered(way.on_timer(now_ns))

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Take a datagram; return it if it survives and is not delayed."""
        if message.flow not in self._ways:
            raise ValueError(f"a network with a way back has no flow {message.flow}")
        return self._numbered(self._ways[message.flow].handle(message, now_ns))

    def _numbered(
        self, outputs: Sequence[Datagram | Record | Notice]
    ) -> list[Datagram | Record | Notice]:
        """Number the inputs over both directions; each answers an input with one row."""
        number, self._inputs = self._inputs, self._inputs + 1
        return [
            output._replace(row=(number, *output.row[1:])) if isinstance(output, Record) else output
            for output in outputs
        ]


def network_of(
    resolved: Scenario, start: Start = BEGINNING, forward: Machine[Datagram] | None = None
) -> Machine[Datagram]:
    """Return the network of a resolved scenario.

    Args:
        resolved: the scenario.
        start: where in the run it takes up its work.
        forward: takes the place of the link from sensor to controller.
    """
    forward = update_link_of(resolved, start) if forward is None else forward
    if not resolved.protocol.acknowledges:
        return forward
    back = link_of(resolved.network.reverse.link, resolved.seeds.loss, ACKNOWLEDGEMENT_LINK, start)
    return Duplex(forward, back, first_number=start.first_number)
