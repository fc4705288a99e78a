"""The network of a run as a machine without sockets: a channel with the scenario's settings.

Simulation and replay drive it. The relay of a live run (:mod:`noack.network_process.run_network`)
decides alike. The flows 0 to N − 1 of a run with N loops come from the sensors, the next N from the
controllers, if acknowledgements or actuations cross the network.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from netem.core.core_library import CData
from netem.core.errors import CallerError
from netem.impairments.link_settings import LinkSettings
from netem.link_state import LinkState
from noack.core.core_library import core, ffi
from noack.machines.channel import Channel
from noack.protocol.record_tables import NETEM_SETTING
from noack.protocol.roles import Notice, Record
from noack.protocol.wire_format import KEY_BYTES, Encoder, Flow, Message
from noack.scenario.parameter_changes import ChangeSchedule, ParameterChange
from noack.scenario.scenario import Scenario

UserNetwork = Callable[[bytes, int], int | None]
"""Maps an update's datagram and the current time, ns, to its delay, ns, or to None for a loss."""

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


class RunChannel(Channel):
    """A channel whose settings change at announced times.

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
        super().__init__(links, flows=loops, asks=network is not None)
        self._schedule, self._network = schedule, network

    def answer(self, question: int) -> None:
        """Do what the core asked for; the call is then repeated."""
        if question == core.NOACK_ASK_CHANGE:
            self._change()
        elif question == core.NOACK_ASK_OUTCOME:
            self.decide(encode_message(self.core.asked.message))
        else:
            super().answer(question)

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

    def decide(self, data: bytes) -> None:
        """Let the user's network decide for the datagram that the core asked about."""
        assert self._network is not None
        delay_ns = self._network(data, self.core.asked_ns)
        self.core.outcome_ns = -1 if delay_ns is None else delay_ns
        self.core.answered = 1


def channel_of(resolved: Scenario, *, loops: int = 1, network: UserNetwork | None = None) -> RunChannel:
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
    return RunChannel(links, loops=loops, schedule=schedule, network=network)


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
