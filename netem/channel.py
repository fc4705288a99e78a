"""The network of a run as a machine without sockets: native/network/channel.c decides, this configures it.

Simulation and replay drive it. The relay of a live run (:mod:`netem.run_network`) decides
alike. The flows 0 to N − 1 of a run with N loops come from the sensors, the next N from the
controllers, if acknowledgements or actuations cross the network. The two directions are
independent: each has its own settings, random streams and guarantee. Payloads are not interpreted.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.link_state import LinkState
from noack.core.core_library import CData, core, dtype_of, ffi, new_handle, pointer_to, rows_at
from noack.core.errors import CallerError
from noack.impairments.link_settings import LinkSettings
from noack.protocol.record_tables import NETEM_PACKET, NETEM_RELEASE, NETEM_SETTING, PACKET_HEAD_BYTES
from noack.protocol.roles import Notice, Record
from noack.protocol.wire_format import KEY_BYTES, Encoder, Flow, Message
from noack.scenario.parameter_changes import ChangeSchedule, ParameterChange
from noack.scenario.scenario import Scenario

Rows = NDArray[np.void]

UserNetwork = Callable[[bytes, int], int | None]
"""Maps an update's datagram and the current time, ns, to its delay, ns, or to None for a loss."""

PACKET_ROW = np.dtype(
    [
        *((name, "<i8") for name in dtype_of("noack_packet_row").names[:-1]),  # type: ignore[index]
        ("head", f"V{PACKET_HEAD_BYTES}"),
    ]
)
RUN_ID = 0
"""Run number in the datagrams of every simulated run: a record depends on the scenario alone.

A simulation receives no foreign traffic, so its key need not be secret."""


def link_name(flow: Flow) -> str:
    """Return the name of the link of a flow; part of its random streams' names."""
    return flow.name.lower()


UPDATE_LINK = link_name(Flow.UPDATE)


class Datagram(NamedTuple):
    """A datagram of a flow."""

    flow: int
    data: bytes


class Departure(NamedTuple):
    """A packet that leaves a channel; its payload is kept by the caller."""

    flow: int
    number: int
    bit: int
    """The payload's bit that was flipped; −1 if it is intact."""


class Channel:
    """A ``noack_channel`` with its settings.

    Args:
        links: the direction from the sensors, and that from the controllers if there is one; each
            has room for ``loops`` flows.
        loops: number of loops.
        schedule: announced changes of the first direction's settings; None: there can be none.
        network: decides for the datagrams from the sensors, instead of their link.
    """

    def __init__(
        self,
        links: Sequence[LinkState],
        *,
        loops: int = 1,
        schedule: ChangeSchedule[LinkSettings] | None = None,
        network: UserNetwork | None = None,
    ) -> None:
        self._links, self._loops = tuple(links), loops
        self._schedule, self._network = schedule, network
        for number, link in enumerate(links):
            for loop in range(loops):
                link.start_flow(loop, number * loops + loop)
        cores = [link.core for link in links]
        self.core: CData = new_handle("channel", loops, len(cores), cores, network is not None)
        """The channel, as the core's functions take it; valid as long as this object lives."""
        self._earlier_rows: list[tuple[str, Rows]] = []

    @property
    def links(self) -> Sequence[LinkState]:
        """The directions."""
        return self._links

    def answer(self, question: int) -> None:
        """Do what the core asked for; the call is then repeated."""
        if question == core.NOACK_ASK_CHANGE:
            self._change()
        elif question == core.NOACK_ASK_OUTCOME:
            self.decide(encode_message(self.core.asked.message))
        elif question == core.NOACK_ROWS_FULL:
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

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Accept a change; it applies from the first datagram that arrives at or after its time T.

        A smaller cap applies from that datagram on: if the number of consecutive losses before it
        has reached the new cap, the datagram passes. Hence a loss burst is never longer than the
        largest cap that applied during it.
        """
        assert self._schedule is not None
        return announce_change(self.core, self._schedule, change, now_ns, self.core.reached_ns)

    def _change(self) -> None:
        """Apply the changes that are due at the datagram whose arrival asked for them."""
        assert self._schedule is not None
        first, channel = self.links[0], self.core
        for settings in due_settings(self._schedule, first.settings, channel.change_ns):
            self.change(settings)
        self.core.change_ns = self._schedule.next_ns

    def change(self, settings: LinkSettings) -> None:
        """Apply other settings to the first direction; see native/network/link_change.c."""
        latest_ns = np.full(self.links[0].rows, core.NOACK_NEVER_NS, np.int64)
        core.noack_channel_latest(self.core, 0, pointer_to(latest_ns, "int64_t *"))
        self.links[0].change(settings, latest_ns)

    def decide(self, data: bytes) -> None:
        """Let the user's network decide for the datagram that the core asked about."""
        assert self._network is not None
        delay_ns = self._network(data, self.core.asked_ns)
        self.core.outcome_ns = -1 if delay_ns is None else delay_ns
        self.core.answered = 1


def channel_of(resolved: Scenario, *, loops: int = 1, network: UserNetwork | None = None) -> Channel:
    """Return the network of a resolved scenario; ``network`` replaces the link of the updates."""
    links: list[LinkState] = []
    for flow in resolved.network.flows:
        settings = resolved.network.link_of(flow)
        if network is not None and not links:
            settings = LinkSettings(mansd=None, first_delivered=False)
        links.append(
            LinkState(
                settings,
                resolved.seeds.loss,
                link_name(flow),
                rows=loops,
                any_order=network is not None,
            )
        )
    schedule = None if network else ChangeSchedule(resolved, lambda scenario: scenario.network.link)
    return Channel(links, loops=loops, schedule=schedule, network=network)


def require_stand_alone(scenario: Scenario) -> Scenario:
    """Return a scenario whose network is used outside a run of noack.

    Raises:
        CallerError: the network changes, has several loops, acknowledges, or chooses by errors.
    """
    for name, setting in (("changes", scenario.changes), ("loops", scenario.loops)):
        if setting:
            raise CallerError(
                f"network: the scenario has {name}; outside a run of noack a network serves one "
                f"loop and does not change: remove {name}"
            )
    if scenario.network.protocol != "none":
        raise CallerError('network: nothing is acknowledged here; set protocol = "none"')
    if scenario.network.link.reads_errors:
        raise CallerError("network: maximum_error is for noack's own sensors; take another discipline")
    return scenario


def announce_change(
    core_network: CData,
    schedule: ChangeSchedule[LinkSettings],
    change: ParameterChange,
    now_ns: int,
    reached_ns: int,
) -> Sequence[Record | Notice]:
    """Accept a change for a ``noack_channel`` or ``noack_relay``; it is an input with a number."""
    outputs = schedule.announce(NETEM_SETTING, change, core_network.inputs, now_ns, reached_ns)
    core_network.inputs += 1
    core_network.change_ns = schedule.next_ns
    return outputs


def due_settings(
    schedule: ChangeSchedule[LinkSettings], present: LinkSettings, now_ns: int
) -> Iterator[LinkSettings]:
    """Yield the settings that replace the present ones before a datagram that arrives now."""
    for change in schedule.take(now_ns):
        assert change.prepared is not None
        if change.prepared != present:
            present = change.prepared
            yield present


def encode_message(message: CData) -> bytes:
    """Return the datagram of a simulated run with a ``noack_message``."""
    vector = np.array(ffi.unpack(message.vector, message.entries))
    return Encoder(RUN_ID, bytes(KEY_BYTES)).encode(
        Message(Flow(message.flow), message.sequence, message.t_ns, vector, message.loop, message.error_level)
    )
