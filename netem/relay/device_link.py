"""The link of a shell: between two TUN devices, which :mod:`netem.shell.devices` opens."""

import os
import socket
import struct
from dataclasses import dataclass

from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import DIRECTIONS, Direction
from noack.runtime.address import Address, SocketName

_DROPPED = 11
"""Column of /proc/net/dev with the packets that a full device did not take."""


@dataclass(frozen=True)
class DeviceLink:
    """The link between the two devices, in the place of a :class:`~netem.relay.relay_links.OpenLink`."""

    spec: LinkSpec
    devices: tuple[int, int]
    """The device inside, and the one outside."""
    statistics: tuple[int, int]
    """/proc/net/dev of the two namespaces, whose place in the file system does not matter."""
    names: tuple[str, str]
    namespace: int
    """The network namespace inside."""
    outside6: str | None
    """The address outside of IPv6, if the system has it."""

    discarded = 0
    has_paths = False

    @property
    def name(self) -> SocketName:
        """The address inside, in the form that sockets use."""
        return self.spec.listen

    @property
    def local(self) -> SocketName:
        """The address outside."""
        return self.spec.to

    server = local
    """The same: nothing is sent there by address."""

    @property
    def address(self) -> Address:
        """The address inside."""
        return self.spec.listen

    def drops(self, direction: Direction) -> int:
        """Return how many packets a direction lost because a device was full."""
        device = DIRECTIONS.index(direction)
        text = os.pread(self.statistics[device], 65536, 0).decode()
        line = next(line for line in text.splitlines() if f"{self.names[device]}:" in line)
        return int(line.partition(":")[2].split()[_DROPPED])

    def client_text(self, flow: bytes) -> str:
        """Return a flow as text: protocol, end inside, end outside."""
        version, protocol, is_fragment, _, inner_port, outer_port = struct.unpack_from("!4BHH", flow)
        if version == 0:
            return "not IP"
        size, family = (4, socket.AF_INET) if version == 4 else (16, socket.AF_INET6)
        hosts = (socket.inet_ntop(family, flow[begin : begin + size]) for begin in (8, 24))
        names = {1: "icmp", 6: "tcp", 17: "udp", 58: "icmpv6"}
        words = [names.get(protocol, f"protocol {protocol}")]
        if is_fragment:
            words[0] += " fragments"
        words += [
            f"{host if version == 4 else f'[{host}]'}{f':{port}' if port else ''}"
            for host, port in zip(hosts, (inner_port, outer_port), strict=True)
        ]
        return " ".join(words)

    def close(self) -> None:
        """Close the devices, which end with that."""
        for descriptor in (*self.devices, *self.statistics, self.namespace):
            os.close(descriptor)
