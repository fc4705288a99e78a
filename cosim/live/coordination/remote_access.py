"""Opens a run to other hosts: the credentials with which their processes reach it.

Each run has a certificate authority of its own, whose private key is nowhere but in this process. It
signs a certificate for the recording host and one for each role; how they are used is in
:mod:`noack.runtime.connections.credentials`.
"""

import datetime
import ipaddress
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from cosim.live.coordination.credentials_folder import credentials_folder
from netem.core.address import Address, address_text, parse_address
from netem.core.clock import clock_identity
from netem.core.errors import CallerError, PeerError, why
from noack.protocol.roles import LOOP_ROLES, RECORDER
from noack.runtime.connections.credentials import CA_FILE, CERTIFICATE_FILE, KEY_FILE, RUN_FILE, own_host
from noack.runtime.control_messages import ClockError
from noack.runtime.host_clocks import clock_error, require_small_error
from noack.runtime.run_descriptor import RunAccess, new_descriptor
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario import Scenario

DEFAULT_PORT = 7447
"""Of zenoh."""
_TO_START = datetime.timedelta(days=1)
"""Certificates are valid for so long beside the run."""


class ListenSettings(NamedTuple):
    """Where a run listens, and where the credentials for it are written."""

    address: Address
    folder: Path


def listen_address(text: str) -> Address:
    """Parse an address of this host, ``192.0.2.1`` or ``192.0.2.1:7000``.

    Raise CallerError if it is not an address at which others can reach this host.
    """
    with suppress(ValueError):
        ipaddress.IPv6Address(text.partition("]")[0].removeprefix("["))
        raise CallerError(f"--listen: zenoh's TLS takes no IPv6 address; give an IPv4 address, not {text}")
    if not text.partition(":")[0]:
        raise CallerError("--listen: expected an address of this host")
    host, port = parse_address(text if ":" in text else f"{text}:{DEFAULT_PORT}", "--listen")
    address = ipaddress.ip_address(host.partition("%")[0])
    if not port:
        raise CallerError(f"--listen: expected a port from 1 to 65535; found {text!r}")
    if address.version != 4 or address.is_unspecified or address.is_multicast or address.is_link_local:
        raise CallerError(
            f"--listen: {host} is not an IPv4 address at which other hosts can reach this one; "
            "give one of `ip address`"
        )
    return host, port


def own_clock(settings: ClocksSection) -> ClockError:
    """Return how far this host's clock may be off.

    Raise PeerError if that is more than the settings allow, MachineError if chrony has not
    synchronised it.
    """
    error = clock_error(clock_identity(), settings.largest_error_us)
    require_small_error("the clock of this host", error, settings)
    return error


def require_free(address: Address) -> None:
    """Raise CallerError if this host cannot listen on an address."""
    with socket.socket() as endpoint:
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            endpoint.bind(address)
            own_host(address)  # refuses a broadcast address
        except (OSError, PeerError) as error:
            reason = why(error) if isinstance(error, OSError) else error
            raise CallerError(f"cannot listen on {address_text(address)}: {reason}") from None


@contextmanager
def credentials(listening: ListenSettings, access: RunAccess, scenario: Scenario) -> Iterator[RunAccess]:
    """Write the folder of credentials; yield the access of the end that listens.

    The folder is private: each role's part of it gives access to the run. It is removed at the end.
    Raise CallerError if it cannot be written.
    """
    folder = listening.folder
    access = access.model_copy(update={"remote": listening.address, "launched": False})
    with ExitStack() as stack:
        try:
            stack.enter_context(credentials_folder(folder, _files(listening, access, scenario)))
        except OSError as error:
            raise CallerError(f"{folder}: the credentials cannot be written: {why(error)}") from None
        yield access.model_copy(update={"credentials": str((folder / RECORDER).resolve())})


def _files(listening: ListenSettings, access: RunAccess, scenario: Scenario) -> dict[str, bytes]:
    """Return the content of each role's files, by their paths in the folder of credentials."""
    from cosim.live.coordination.certificate_authority import CertificateAuthority  # imports cryptography

    run_s = scenario.horizon_s / scenario.speed
    authority = CertificateAuthority(_TO_START + datetime.timedelta(seconds=run_s))
    files: dict[str, bytes] = {}
    for role in (RECORDER, *LOOP_ROLES):
        address = listening.address[0] if role == RECORDER else None
        certificate, key = authority.key_pair(role, address)
        files |= {
            f"{role}/{CA_FILE}": authority.certificate,
            f"{role}/{CERTIFICATE_FILE}": certificate,
            f"{role}/{KEY_FILE}": key,
        }
        if role != RECORDER:
            of_role = access.model_copy(update={"credentials_for": role})
            descriptor = new_descriptor(of_role, scenario)
            files[f"{role}/{RUN_FILE}"] = (descriptor.model_dump_json(indent=1) + "\n").encode()
    return files
