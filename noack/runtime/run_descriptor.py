"""The run descriptor: what a process needs to join a run. An invitation is one for another host.

It contains the run's secret key, so it is never on a command line or in the environment. The
launcher writes it to the standard input of launched processes. For processes started by hand it is
in a file of the user's runtime directory, which only its owner can read. An invitation has also the
address of the control plane and keys for it: whoever can read it can take part in the run.
"""

import os
import secrets
import socket
import stat
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat, ValidationError

from noack.core.clock import clock_identity
from noack.core.errors import CallerError, PeerError, why
from noack.core.file_access import new_file, open_regular, read_regular
from noack.impairments.target_loss import find_probabilities, store_probabilities
from noack.protocol.wire_format import KEY_BYTES
from noack.runtime.address import LOOPBACK, Address, address_text, family_of
from noack.runtime.control_messages import NumericHost, SocketAddress
from noack.runtime.private_folder import live_lock_files, lock_file, require_name
from noack.scenario.scenario import Scenario
from noack.scenario.toml_file import brief
from noack.settings.section import ScenarioSection, Seed

DEFAULT_SESSION = "default"
STANDARD_INPUT = Path("-")
"""An invitation by this name is read from standard input."""
_MOST_BYTES = 64 * 2**20
"""Of an invitation: more than any scenario needs."""


class RemoteAccess(ScenarioSection):
    """Access of a process on another host to the coordinator: by TLS, with keys made for the run."""

    host: NumericHost
    port: Annotated[int, Field(ge=1, le=65_535)]
    coordinator: str  # its certificate, and that of those that join with its key, as PEM text
    certificate: str
    private_key: str
    valid_until: str  # for people; the coordinator measures the time itself


class RunDescriptor(ScenarioSection):
    """All that a process needs to join a run; its JSON has the key in hexadecimal."""

    model_config = ConfigDict(val_json_bytes="hex", ser_json_bytes="hex")

    run_id: Seed
    key: Annotated[bytes, Field(min_length=KEY_BYTES, max_length=KEY_BYTES)]
    run_dir: str
    launched: bool  # by a launcher, whose end closes the process's standard input
    join_token: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
    """The coordinator knows which roles it admits, and until when."""
    host: str = LOOPBACK  # where the sockets of loop data listen
    remote: RemoteAccess | None = None  # of an invitation
    clock: str
    """The coordinator's monotonic clock, of which the run's epoch is a reading."""
    time_reference: SocketAddress | None = None
    """Address at which processes with another clock compare it with the coordinator's, under the run's
    key."""
    target_losses: Annotated[dict[str, FiniteFloat], AfterValidator(store_probabilities)] = Field({})
    """Probabilities that the check of the scenario needs."""
    scenario: Scenario  # resolved


def new_descriptor(scenario: Scenario, run_dir: Path, *, launched: bool) -> RunDescriptor:
    """Return a run descriptor with a fresh run id and key."""
    return RunDescriptor(
        run_id=secrets.randbits(64),
        key=secrets.token_bytes(KEY_BYTES),
        run_dir=str(run_dir),
        launched=launched,
        join_token=new_join_token(),
        clock=clock_identity(),
        target_losses=find_probabilities(*map(scenario.network.link_of, scenario.network.flows)),
        scenario=scenario,
    )


def new_join_token() -> str:
    """Return a random join token."""
    return secrets.token_hex(16)


def loads(text: str) -> RunDescriptor:
    """Parse a run descriptor; raise CallerError if the text is not one."""
    try:
        return RunDescriptor.model_validate_json(text)
    except ValidationError as error:
        raise CallerError(f"not a valid run descriptor: {brief(error)}") from None


@contextmanager
def descriptor_file(descriptor: RunDescriptor, session: str) -> Iterator[Path]:
    """Publish the run descriptor in a file that only its owner can read, while the context lasts.

    The file is locked: if several runs use a session's name, one succeeds. Raise CallerError if
    another run is open in the session, or the folder is not the user's own.
    """
    require_name(session, "session")
    with ExitStack() as stack:
        try:
            yield stack.enter_context(lock_file("", session, descriptor.model_dump(mode="json")))
        except FileExistsError:
            raise CallerError(
                f"session {session!r}: another run is open in it; choose --session NAME"
            ) from None


def find_descriptor(session: str) -> RunDescriptor | None:
    """Return the run descriptor published in a session by a recorder or launcher, or None."""
    require_name(session, "session")
    files = live_lock_files("", session)
    return loads(files[0].content.decode()) if files else None


@contextmanager
def invitation_file(path: Path, descriptor: RunDescriptor) -> Iterator[None]:
    """Write an invitation that only its owner can read; replace an older one.

    At the end it is removed, unless that of another run has replaced it. Raise CallerError if it
    cannot be written.
    """
    write_invitation(path, descriptor)
    try:
        yield
    finally:
        with suppress(OSError, ValueError):
            if read_regular(path, _MOST_BYTES) == _content(descriptor):
                path.unlink()


def write_invitation(path: Path, descriptor: RunDescriptor) -> None:
    """Write an invitation that only its owner can read; replace an older one.

    Raise CallerError if it cannot be written.
    """
    try:
        with new_file(path, make_folder=False, mode=0o600) as file:
            file.write(_content(descriptor))
    except (OSError, ValueError) as error:
        raise CallerError(f"{path}: the invitation cannot be written: {why(error)}") from None


def _content(descriptor: RunDescriptor) -> bytes:
    return (descriptor.model_dump_json(indent=1) + "\n").encode()


def read_invitation(path: Path, runs: Path) -> RunDescriptor:
    """Return the run descriptor of an invitation, as this host uses it.

    Sockets of loop data listen on the address from which this host reaches the coordinator. Rows
    that cannot be sent to the recorder stay below ``runs``, in a folder with the run's name. Raise
    CallerError if it cannot be read, other users can read it, or it is no invitation; or ``runs``
    cannot be written; PeerError if there is no route to the coordinator.
    """
    text = _text(path)
    try:
        descriptor = loads(text)
    except CallerError as error:
        raise CallerError(f"{path}: not an invitation: {error}") from None
    if descriptor.remote is None:
        raise CallerError(f"{path}: not an invitation, but a run descriptor for this host")
    name = Path(descriptor.run_dir).name
    if name in ("", "..") or "\0" in name:
        raise CallerError(f"{path}: not an invitation: its run directory has no name")
    _require_writable(runs.resolve())
    run_dir = runs.resolve() / name
    host = own_host((descriptor.remote.host, descriptor.remote.port))
    return descriptor.model_copy(update={"host": host, "run_dir": str(run_dir)})


def _text(path: Path) -> str:
    try:
        if path == STANDARD_INPUT:
            content = sys.stdin.buffer.read(_MOST_BYTES + 1)
        else:
            with open_regular(path) as file:
                status = os.fstat(file.fileno())
                if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
                    raise CallerError(
                        f"{path}: it has secret keys, but other users can read or change it; "
                        f"make it yours alone: chmod 600 {path}"
                    )
                content = file.read(_MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise CallerError(f"{path}: the invitation cannot be read: {why(error)}") from None
    if len(content) > _MOST_BYTES:
        raise CallerError(f"{path}: not an invitation: larger than {_MOST_BYTES // 2**20} MiB")
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise CallerError(f"{path}: not an invitation: it is not text") from None


def _require_writable(folder: Path) -> None:
    """Raise CallerError unless a folder can be made or written: rows may have to be kept there."""
    nearest = folder
    while not os.access(nearest, os.F_OK) and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir():
        raise CallerError(f"{folder}: rows could not be kept there: {nearest} is not a folder")
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise CallerError(f"{folder}: rows could not be kept there: {nearest} is not writable")


def own_host(address: Address) -> str:
    """Return the numeric address from which this host sends to another one.

    Raise PeerError without a route.
    """
    with socket.socket(family_of(address), socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(address)  # sends nothing
        except OSError as error:
            raise PeerError(f"cannot reach {address_text(address)}: {why(error)}") from None
        return str(probe.getsockname()[0])
