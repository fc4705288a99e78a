"""The ticket: what a process needs to join a run.

It contains the run's secret key, so it is never on a command line or in the environment. The
launcher writes it to the standard input of launched processes. For processes started by hand it is
in a file of the user's runtime directory, which only its owner can read.
"""

import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat, ValidationError

from noack.config.scenario import Scenario
from noack.config.toml_file import brief
from noack.core.errors import CallerError, PeerError
from noack.impairments.loss_prediction import found_probabilities, remember
from noack.protocol.datagram_seal import KEY_BYTES
from noack.runtime.address import LOOPBACK
from noack.runtime.control_messages import NumericHost, SocketAddress
from noack.runtime.host_clock import clock_identity
from noack.runtime.lock_file import live_lock_file, lock_file
from noack.runtime.private_folder import private_folder, require_name
from noack.settings.section import ScenarioSection, Seed

DEFAULT_SESSION = "default"


class RemoteAccess(ScenarioSection):
    """How a process on another host reaches the coordinator: by TLS, with keys made for the run."""

    host: NumericHost
    port: Annotated[int, Field(ge=1, le=65_535)]
    authority: str  # certificates, and the key of this one, as PEM text
    certificate: str
    private_key: str
    valid_until: str  # for people; the coordinator measures the time itself


class Ticket(ScenarioSection):
    """What a process needs to join a run; its JSON has the key in hexadecimal."""

    model_config = ConfigDict(val_json_bytes="hex", ser_json_bytes="hex")

    run_id: Seed
    key: Annotated[bytes, Field(min_length=KEY_BYTES, max_length=KEY_BYTES)]
    run_dir: str
    launched: bool  # whether a launcher holds the process's standard input open as its lifeline
    admission_pass: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
    """The coordinator knows which roles it admits, and until when."""
    host: str = LOOPBACK  # where the sockets of loop data listen
    remote: RemoteAccess | None = None  # of an invitation
    clock: str
    """The coordinator's monotonic clock, of which the run's epoch is a reading."""
    time_reference: SocketAddress | None = None
    """Where processes with another clock compare it with the coordinator's, under the run's key."""
    kept_losses: Annotated[dict[str, FiniteFloat], AfterValidator(remember)] = Field({})
    """Probabilities that the check of the scenario needs."""
    scenario: Scenario  # resolved


def new_ticket(scenario: Scenario, run_dir: Path, *, launched: bool) -> Ticket:
    """Return a ticket with a fresh run id and key."""
    return Ticket(
        run_id=secrets.randbits(64),
        key=secrets.token_bytes(KEY_BYTES),
        run_dir=str(run_dir),
        launched=launched,
        admission_pass=new_admission_pass(),
        clock=clock_identity(),
        kept_losses=found_probabilities(*map(scenario.network.link_of, scenario.network.flows)),
        scenario=scenario,
    )


def new_admission_pass() -> str:
    """Return a random pass."""
    return secrets.token_hex(16)


def loads(text: str) -> Ticket:
    """Parse a ticket; raise CallerError if the text is not one."""
    try:
        return Ticket.model_validate_json(text)
    except ValidationError as error:
        raise CallerError(f"not a valid ticket: {brief(error)}") from None


def ticket_path(session: str) -> Path:
    """Return the path of a session's ticket; raise CallerError for an unfit name."""
    require_name(session, "session")
    return private_folder() / f"{session}.json"


@contextmanager
def published(ticket: Ticket, session: str) -> Iterator[Path]:
    """Publish the ticket in a file that only its owner can read, while the context lasts.

    The file is locked: if several runs use a session's name, one succeeds. Raise CallerError if
    another run is open in the session, or the folder is not the user's own.
    """
    path = ticket_path(session)
    with ExitStack() as stack:
        try:
            stack.enter_context(lock_file("", session, ticket.model_dump(mode="json")))
        except FileExistsError:
            raise CallerError(
                f"session {session!r}: another run is open in it; choose --session NAME"
            ) from None
        yield path


def wait_for_ticket(
    session: str, timeout_s: float, stop: Callable[[], bool], on_wait: Callable[[Path], None]
) -> Ticket:
    """Wait until a recorder or launcher has published the session's ticket, and return it.

    Raise PeerError if there was none in time.
    """
    path = ticket_path(session)
    deadline_s = time.monotonic() + timeout_s
    waiting = False
    while True:
        if (file := live_lock_file("", session)) is not None:
            return loads(file.content.decode())
        if stop() or time.monotonic() > deadline_s:
            raise PeerError(
                f"no run to join in session {session!r}: start `noack record SCENARIO` first"
            )
        if not waiting:
            on_wait(path)
            waiting = True
        time.sleep(0.05)
