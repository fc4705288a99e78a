"""Opens a run to other hosts: TLS listener, invitation, and answers to questions about the time.

The coordinator has a certificate, and all that join have one, each signed by itself. Each end
accepts only the other one's.
"""

import asyncio
import datetime
import ipaddress
import socket
import ssl
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from cosim.live.coordination.coordinator import Coordinator, TokenScope
from noack.core.errors import CallerError, PeerError, why
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.active_runs import RUNS, run_name
from noack.runtime.address import Address, address_text, family_of, parse_address
from noack.runtime.connections.coordinator_link import InvitationProof, Protection, forwarding, tls_context
from noack.runtime.connections.zenoh_session import socket_path
from noack.runtime.host_clocks.time_exchange import TimeReference, answering
from noack.runtime.run_descriptor import RemoteAccess, RunDescriptor, new_join_token, own_host
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario import Scenario

_MOST_PENDING_CONNECTIONS = 4096
_FLOOD_PER_S = 100
"""Connections without an invitation that are a flood."""
_VALIDITY = datetime.timedelta(days=3650)
"""A run may be long, and the hosts' dates may differ; an invitation ends with its join token."""
_CALM_S, _MOST_CALM_S = 3, 60
"""Time without a flood, after which it is over; and the longest such time."""


class ListenSettings(NamedTuple):
    """Where a run listens, and whom it invites."""

    address: Address
    invitation: Path
    """Where the invitation is written."""
    role: str | None = None
    """The one role that the invitation is for; None for all."""
    valid_s: float = 3600.0


class RunListener(NamedTuple):
    """A run that is open to other hosts."""

    address: Address
    invitation: RunDescriptor
    notices: SimpleQueue[str]
    """Lines for the person who watches the run: floods."""


def listen_address(text: str, option: str = "--listen") -> Address:
    """Parse an address of this host: ``192.0.2.1``, ``192.0.2.1:7000``, ``2001:db8::1``.

    Raise CallerError if it is not an address at which others can reach this host.
    """
    with suppress(ValueError):  # an IPv6 address without brackets
        text = f"[{ipaddress.IPv6Address(text)}]"
    if text.endswith("]") or ":" not in text:
        text += ":0"
    if text.startswith(":") or not text:
        raise CallerError(f"{option}: expected an address of this host")
    host, port = parse_address(text, option)
    address = ipaddress.ip_address(host.partition("%")[0])
    mapped = isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None
    if address.is_unspecified or address.is_multicast or address.is_link_local or mapped:
        raise CallerError(
            f"{option}: {host} is not an address at which other hosts can reach this one; "
            "give one of `ip address`"
        )
    return host, port


def with_clocks(scenario: Scenario) -> Scenario:
    """Return a scenario whose run on several hosts records the bounds of its clocks' errors."""
    if scenario.clocks is not None:
        return scenario
    return scenario.model_copy(update={"clocks": ClocksSection()})


def _listen(address: Address) -> socket.socket:
    endpoint = socket.socket(family_of(address), socket.SOCK_STREAM)
    endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        endpoint.bind(address)
        endpoint.listen(_MOST_PENDING_CONNECTIONS)
        own_host(endpoint.getsockname()[:2])  # refuses a broadcast address
    except (OSError, PeerError) as error:
        endpoint.close()
        reason = why(error) if isinstance(error, OSError) else error
        raise CallerError(f"cannot listen on {address_text(address)}: {reason}") from None
    return endpoint


@contextmanager
def open_to_hosts(
    listening: ListenSettings, descriptor: RunDescriptor, coordinator: Coordinator
) -> Iterator[RunListener]:
    """Listen for processes of other hosts meanwhile, and make their invitation.

    Raise CallerError if the address cannot be used.
    """
    keys, path = new_tls_keys(listening.address[0]), socket_path(RUNS, run_name(descriptor.run_id))
    with ExitStack() as stack:
        endpoint = stack.enter_context(_listen(listening.address))
        host, port = endpoint.getsockname()[:2]
        floods = ConnectionFloodWatch()
        proof = InvitationProof(descriptor.key)
        protection = Protection(coordinator_context(keys), proof, floods.next_interval)
        stack.enter_context(forwarding(endpoint, lambda: asyncio.open_unix_connection(path), protection))
        times = TimeReference((host, listening.address[1]), descriptor.key)
        stack.callback(times.close)
        stack.enter_context(answering(times))
        until = datetime.datetime.now().astimezone() + datetime.timedelta(seconds=listening.valid_s)
        remote = RemoteAccess(
            host=host,
            port=port,
            coordinator=keys.coordinator.certificate,
            **keys.joining._asdict(),
            valid_until=until.isoformat(timespec="seconds"),
        )
        join_token = new_join_token()
        roles = LOOP_ROLES if listening.role is None else (listening.role,)
        coordinator.join_tokens[join_token] = TokenScope(roles, time.monotonic() + listening.valid_s)
        invited = {
            "launched": False,
            "join_token": join_token,
            "remote": remote,
            "time_reference": times.address,
        }
        yield RunListener((host, port), descriptor.model_copy(update=invited), floods.lines)


class ConnectionFloodWatch:
    """Reports the begin and the end of a flood of connections without an invitation.

    The end is reported after a number of consecutive calm intervals, which doubles with each flood,
    so that repeated floods print few lines.
    """

    def __init__(self) -> None:
        self.lines: SimpleQueue[str] = SimpleQueue()
        self._ended = self._calm = 0
        self._needed = _CALM_S

    def next_interval(self, count: Counter[str]) -> None:
        """Count connections that ended in a second without an invitation, by host."""
        total = count.total()
        if total >= _FLOOD_PER_S:
            self._calm = 0
            if not self._ended:
                self.lines.put(
                    f"flood: {total} connections without an invitation in a second, from "
                    f"{len(count)} addresses, most from {count.most_common(1)[0][0]}; "
                    "processes with an invitation can still join"
                )
            self._ended += total
        elif self._ended:
            self._ended += total
            self._calm += 1
            if self._calm >= self._needed:
                self.lines.put(f"the flood is over: {self._ended} connections without an invitation ended")
                self._ended, self._needed = 0, min(2 * self._needed, _MOST_CALM_S)


class KeyPair(NamedTuple):
    """A certificate and its private key, as PEM text."""

    certificate: str
    private_key: str


class TlsKeys(NamedTuple):
    """The keys of one run."""

    coordinator: KeyPair
    joining: KeyPair


def new_tls_keys(host: str) -> TlsKeys:
    """Return keys for a coordinator at a numeric address."""
    return TlsKeys(
        _new_key_pair(x509.IPAddress(ipaddress.ip_address(host))),
        _new_key_pair(x509.DNSName("joining")),
    )


def _new_key_pair(owner: x509.GeneralName) -> KeyPair:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "noack run")])
    now = datetime.datetime.now(datetime.UTC)
    certificate = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - _VALIDITY)
        .not_valid_after(now + _VALIDITY)
        .add_extension(x509.SubjectAlternativeName([owner]), critical=False)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    private = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return KeyPair(certificate.public_bytes(pem).decode(), private.decode())


def coordinator_context(keys: TlsKeys) -> ssl.SSLContext:
    """Return the TLS settings of the coordinator's end."""
    return tls_context(keys.joining.certificate, *keys.coordinator, server=True)
