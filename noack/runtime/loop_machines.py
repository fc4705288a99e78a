"""The machines of a process: one for each loop, or compiled ones of many."""

import secrets
import socket
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from functools import partial

from noack.config.fleet_layout import FleetRole
from noack.config.resolution import resolved_loops
from noack.config.scenario import Scenario
from noack.protocol.datagram_seal import KEY_BYTES
from noack.protocol.fleet import Fleet, FleetDecoder
from noack.protocol.machine_interface import Machine, Start
from noack.protocol.topology import ENDS, RECEIVES, SENDS, receiver_of, sender_to
from noack.protocol.wire_format import Decoder, Encoder, Flow, Message
from noack.runtime.address import Address
from noack.runtime.fleet.compiled_fleet import CompiledFleet
from noack.runtime.fleet.fleet_choice import fleet_of
from noack.runtime.fleet.fleet_socket import FleetSocket
from noack.runtime.process_life import RunProcess
from noack.runtime.rehearsal import Rehearsal, can_rehearse
from noack.runtime.udp_sockets import MessageSocket, bind

NewMachine = Callable[[Scenario, Start], Machine[Message]]
"""Makes the machine of a loop, from its resolved scenario and its beginning in the loop's time."""


def run_machines(process: RunProcess, new_machine: NewMachine, compiled: FleetRole) -> None:
    """Run the machines of all loops, with the process's route in the topology.

    Args:
        process: the process, admitted to the run.
        new_machine: makes a machine; another of the first loop is made for rehearsals.
        compiled: the machines of many loops as compiled code.
    """
    fleet = None
    if not process.start.is_restart:
        ticket = process.ticket
        fleet = fleet_of(compiled, process.role, process.scenario, ticket.run_id, ticket.key)
    if fleet is not None:
        process.run(fleet, partial(_fleet_socket, process, fleet))
        return
    loops = _Loops(process, new_machine)
    with ExitStack() as stack:
        if can_rehearse(process.role, loops.scenarios[0]):
            endpoint = stack.enter_context(closing(bind(0, "realtime.rehearse")))
            process.rehearsal = stack.enter_context(closing(loops.rehearsal(endpoint)))
        process.run(loops.machine(), loops.channel)


def _fleet_socket(
    process: RunProcess,
    fleet: CompiledFleet,
    endpoint: socket.socket,
    addresses: Mapping[str, Address],
) -> FleetSocket:
    source, destination = _ends(process, addresses)
    sends, clock = SENDS[process.role], process.clock
    return FleetSocket(endpoint, fleet, sends, clock=clock, source=source, destination=destination)


def _ends(process: RunProcess, addresses: Mapping[str, Address]) -> tuple[Address, Address]:
    """Return where the process's messages come from, and where they go."""
    role, network = process.role, process.scenario.network.flows
    source = addresses[sender_to(role, RECEIVES[role], network)]
    return source, addresses[receiver_of(role, SENDS[role], network)]


class _Loops:
    """Makes what a process needs to run a machine for each loop."""

    def __init__(self, process: RunProcess, new_machine: NewMachine) -> None:
        self._process, self._new_machine = process, new_machine
        self.scenarios = resolved_loops(process.scenario)

    def machine(self, most: int | None = None) -> Fleet:
        """Return the machine of all loops, or of the first ones."""
        start, phases_ns = self._process.start, self._process.phases_ns[:most]
        machines = [
            self._new_machine(loop, start._replace(from_ns=start.from_ns - phase_ns))
            for loop, phase_ns in zip(self.scenarios, phases_ns, strict=False)
        ]
        return Fleet(machines, phases_ns)

    def channel(self, endpoint: socket.socket, addresses: Mapping[str, Address]) -> MessageSocket:
        """Return the socket of all loops."""
        process, answer = self._process, Flow.ACKNOWLEDGEMENT
        answers = answer in process.scenario.network.flows and process.role in ENDS[answer]
        is_answered = answers and process.role == ENDS[answer].receiver
        source, destination = _ends(process, addresses)
        by = addresses["netem"]
        return MessageSocket(
            endpoint,
            self._decoder(RECEIVES[process.role], not_before_ns=process.admitted_ns),
            self._encoder(),
            SENDS[process.role],
            source=source,
            destination=destination,
            acknowledgements=(self._decoder(answer), by) if is_answered else None,
            acknowledges_to=by if answers and not is_answered else None,
        )

    def rehearsal(self, endpoint: socket.socket) -> Rehearsal:
        """Return a rehearsal of the first loop's machine; its messages come back to it.

        They are made under a key of their own: they have sequence numbers of the run's messages.
        """
        receives, sends = RECEIVES[self._process.role], SENDS[self._process.role]
        own: Address = endpoint.getsockname()
        key = secrets.token_bytes(KEY_BYTES)
        copy = MessageSocket(
            endpoint, self._decoder(receives, 1, key=key), self._encoder(key), sends,
            source=own, destination=own,
        )  # fmt: skip
        entries = self.scenarios[0].message_sizes.entries(receives)
        return Rehearsal(self.machine(1), copy, self._encoder(key), receives, entries)

    def _encoder(self, key: bytes | None = None) -> Encoder:
        ticket, encrypted = self._process.ticket, self._process.scenario.network.encrypted
        return Encoder(ticket.run_id, key or ticket.key, encrypted=encrypted)

    def _decoder(
        self,
        flow: Flow,
        most: int | None = None,
        *,
        key: bytes | None = None,
        not_before_ns: int = 0,
    ) -> FleetDecoder:
        """Return the decoder of a flow of all loops, or of the first ones."""
        ticket, phases_ns = self._process.ticket, self._process.phases_ns[:most]
        encrypted = self._process.scenario.network.encrypted
        decoders = [
            Decoder(
                flow,
                0 if flow == Flow.ACKNOWLEDGEMENT else loop.message_sizes.entries(flow),
                ticket.run_id,
                key or ticket.key,
                not_before_ns=not_before_ns - phase_ns,
                loop=number,
                encrypted=encrypted,
            )
            for number, (loop, phase_ns) in enumerate(zip(self.scenarios, phases_ns, strict=False))
        ]
        return FleetDecoder(decoders)
