"""The run descriptor: what a process needs to join a run.

It contains the run's secret key, so it is never on a command line or in the environment. The
launcher writes it to the standard input of launched processes. For processes started by hand it is
in a file of the user's runtime directory, which only its owner can read. For a process on another
host it is among its credentials (``connections/credentials.py``).
"""

import secrets
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ConfigDict, Field, FiniteFloat, ValidationError

from netem.core.address import LOOPBACK
from netem.core.clock import clock_identity
from netem.core.errors import CallerError
from netem.core.private_folder import live_lock_files, lock_file, require_name
from netem.core.settings_section import ScenarioSection, Seed
from netem.core.toml_file import brief
from netem.impairments.target_loss import known_probabilities, store_probabilities
from noack.protocol.wire_format import KEY_BYTES
from noack.runtime.control_messages import SocketAddress
from noack.scenario.scenario import Scenario

DEFAULT_SESSION = "default"
DESCRIPTOR_ON_STDIN = "NOACK_DESCRIPTOR_ON_STDIN"
"""Environment variable of a launched process: its first line of input is its run descriptor."""


class RunAccess(ScenarioSection):
    """How a process reaches a run, and who may; its JSON has the key in hexadecimal."""

    model_config = ConfigDict(val_json_bytes="hex", ser_json_bytes="hex")

    run_id: Seed
    key: Annotated[bytes, Field(min_length=KEY_BYTES, max_length=KEY_BYTES)]
    run_dir: str
    launched: bool  # by a launcher, whose end closes the process's standard input
    host: str = LOOPBACK  # where the sockets of loop data listen
    remote: SocketAddress | None = None
    """Where processes of other hosts reach the control plane; None: they do not."""
    credentials: str = ""
    """Folder with the certificates of this end of such connections."""
    credentials_for: str = ""
    """The role that a process on another host has."""
    clock: str
    """The coordinator's monotonic clock, of which the run's epoch is a reading."""


class RunDescriptor(RunAccess):
    """All that a process needs to join a run."""

    target_losses: Annotated[dict[str, FiniteFloat], AfterValidator(store_probabilities)] = Field({})
    """Probabilities that the check of the scenario needs."""
    scenario: Scenario  # resolved


def new_access(run_dir: Path, *, launched: bool) -> RunAccess:
    """Return the access to a new run, with a fresh run id and key."""
    return RunAccess(
        run_id=secrets.randbits(64),
        key=secrets.token_bytes(KEY_BYTES),
        run_dir=str(run_dir),
        launched=launched,
        clock=clock_identity(),
    )


def new_descriptor(access: RunAccess, scenario: Scenario) -> RunDescriptor:
    """Return the run descriptor for a process that reaches a run like this."""
    return RunDescriptor(
        **{name: getattr(access, name) for name in RunAccess.model_fields},
        target_losses=known_probabilities(*map(scenario.network.link_of, scenario.network.flows)),
        scenario=scenario,
    )


def parse_descriptor(text: str) -> RunDescriptor:
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
    return parse_descriptor(files[0].content.decode()) if files else None
