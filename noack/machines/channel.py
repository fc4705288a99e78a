"""A network as a machine without sockets: native/driver/channel.c decides, this configures it.

Its one or two directions are independent: each has its own settings, random streams and guarantee.
Each direction has the same number of flows: 0 to N − 1 are the first direction's, the next N the
second's. Payloads are not interpreted.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import CData, rows_at
from netem.core.packet_rows import NETEM_PACKET, NETEM_RELEASE, PACKET_ROW
from netem.impairments.link_settings import LinkSettings
from netem.link_state import LinkState
from noack.core.core_library import core, ffi, new_handle, pointer_to

Rows = NDArray[np.void]


class Departure(NamedTuple):
    """A packet that leaves a channel; its payload is kept by the caller."""

    flow: int
    number: int
    bit: int
    """The payload's bit that was flipped; −1 if it is intact."""


class Channel:
    """A ``noack_channel`` with its settings.

    Args:
        links: one or two directions, each with room for ``flows`` flows.
        flows: number of flows of each direction.
        asks: whether the caller decides for the packets of the first direction, instead of its link
            (:meth:`answer`).
    """

    def __init__(self, links: Sequence[LinkState], *, flows: int = 1, asks: bool = False) -> None:
        self._links = tuple(links)
        for number, link in enumerate(links):
            for flow in range(flows):
                link.start_flow(flow, number * flows + flow)
        cores = [link.core for link in links]
        self.core: CData = new_handle("channel", flows, len(cores), cores, asks)
        """The channel, as the core's functions take it; valid as long as this object lives."""
        self._earlier_rows: list[tuple[str, Rows]] = []

    @property
    def links(self) -> Sequence[LinkState]:
        """The directions."""
        return self._links

    def answer(self, question: int) -> None:
        """Do what the core asked for; the call is then repeated."""
        if question == core.NOACK_ROWS_FULL:
            self._earlier_rows = self.take_rows()
        else:
            assert question == core.NOACK_NO_MEMORY
            raise MemoryError

    def send(self, flow: int, number: int, size_bytes: int, now_ns: int) -> tuple[list[Departure], int]:
        """Take a packet of a flow; return what leaves at once, and the number of its copies.

        What is due must have left (:meth:`release`). Of a lost packet there are 0 copies.
        """
        message = {"sequence": number}
        datagram = ffi.new("noack_datagram *", {"message": message, "flow": flow, "bit": -1})
        datagram.size_bytes, datagram.arrival_ns = size_bytes, now_ns
        earlier_count = self.core.delayed_count
        leaving = self._departures(lambda: core.noack_channel_handle(self.core, datagram, now_ns))
        return leaving, self.core.delayed_count - earlier_count

    @property
    def due_ns(self) -> int:
        """When the next packet leaves; :data:`NEVER_NS`: there is none."""
        return int(core.noack_channel_due_ns(self.core))

    def release(self, now_ns: int) -> list[Departure]:
        """Let what is due leave; return it in its order."""
        leaving: list[Departure] = []
        while (due_ns := self.due_ns) <= now_ns:
            leaving += self._departures(partial(core.noack_channel_release, self.core, due_ns))
        return leaving

    def _departures(self, step: Callable[[], int]) -> list[Departure]:
        while (question := step()) != core.NOACK_DONE:
            self.answer(question)
        departures = (self.core.leaving[index] for index in range(self.core.leaving_count))
        return [Departure(packet.flow, packet.message.sequence, packet.bit) for packet in departures]

    def take_rows(self) -> list[tuple[str, Rows]]:
        """Return all rows since the last call, in batches of a table in their order."""
        channel, batches = self.core, self._earlier_rows
        packets = rows_at(channel.packets, channel.packet_count).view(PACKET_ROW).copy()
        releases = rows_at(channel.releases, channel.release_count).copy()
        channel.packet_count = channel.release_count = 0
        self._earlier_rows = []
        return [*batches, (NETEM_PACKET, packets), (NETEM_RELEASE, releases)]

    def change(self, settings: LinkSettings) -> None:
        """Apply other settings to the first direction; see native/network/link_change.c."""
        latest_ns = np.full(self.links[0].rows, core.NOACK_NEVER_NS, np.int64)
        core.noack_channel_latest(self.core, 0, pointer_to(latest_ns, "int64_t *"))
        self.links[0].change(settings, latest_ns)
