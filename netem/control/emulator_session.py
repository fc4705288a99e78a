"""Session files: where a running emulator can be reached, and the secret that it asks for.

A file lies in the user's runtime directory, readable by its owner only, while the emulator runs
(:mod:`noack.runtime.lock_file`).
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from pydantic import TypeAdapter, ValidationError

from noack.config.validation_messages import brief
from noack.core.errors import CallerError, PeerError
from noack.runtime import lock_file
from noack.runtime.private_folder import require_name


class Session(NamedTuple):
    """How to reach an emulator."""

    name: str
    endpoint: str
    """zenoh endpoint, e.g. ``tcp/127.0.0.1:7447``."""
    token: str
    """The secret; see :mod:`netem.control.control_server`."""


_SESSION = TypeAdapter(Session)
_KIND = "netem"
_STARTING = "netem_starting"


@contextmanager
def published(session: Session) -> Iterator[Path]:
    """Keep a session's file while the context lasts.

    Raises:
        CallerError: the name is unfit or in use, or the folder is not the user's own.
    """
    require_name(session.name, "emulator")
    with ExitStack() as stack:
        try:
            path = stack.enter_context(lock_file.lock_file(_KIND, session.name, session._asdict()))
        except FileExistsError:
            raise _in_use(session.name) from None
        yield path


@contextmanager
def starting(name: str | None) -> Iterator[None]:
    """Let others see that an emulator starts, which may take long; None: nobody can reach it.

    Raises:
        CallerError: the name is unfit or in use, or the folder is not the user's own.
    """
    with ExitStack() as stack:
        if name is not None:
            require_name(name, "emulator")
            try:
                stack.enter_context(lock_file.lock_file(_STARTING, name, {}))
            except FileExistsError:
                raise _in_use(name) from None
            if name in running():
                raise _in_use(name)
        yield


def _in_use(name: str) -> CallerError:
    return CallerError(f"--control {name}: an emulator of this name runs; choose another name")


def running() -> list[str]:
    """Return the names of the emulators of this user that can be reached.

    Raises:
        CallerError: the folder is open to others.
    """
    return list(_files())


def find(name: str | None) -> Session:
    """Return the session of the named emulator, or of the only one that runs.

    Raises:
        CallerError: there is no such emulator, or there are several to choose from.
        PeerError: it is still starting, or its session file cannot be read.
    """
    files = _files()
    begun = [file.path.stem for file in lock_file.live_lock_files(_STARTING)]
    if name not in files and (name in begun or (name is None and begun and not files)):
        raise PeerError(
            f"emulator {name or begun[0]!r} is starting; its first start compiles for some time, "
            "and it says `ready` on its standard output when it can be reached"
        )
    if not files:
        raise CallerError(
            ("no emulator" if name is None else f"no emulator {name!r}")
            + " runs that can be reached; start one with `noack netem --control NAME …`"
        )
    if name is None:
        if len(files) > 1:
            raise CallerError(f"which emulator? There are {', '.join(files)}")
        (name,) = files
    elif name not in files:
        raise CallerError(f"no emulator {name!r} runs; there are {', '.join(files)}")
    try:
        return _SESSION.validate_json(files[name].content, strict=True)
    except ValidationError as error:
        raise PeerError(
            f"emulator {name!r}: its session file cannot be read: {brief(error)}"
        ) from None


def _files() -> dict[str, lock_file.LockFile]:
    return {file.path.stem: file for file in lock_file.live_lock_files(_KIND)}
