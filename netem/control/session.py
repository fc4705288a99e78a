"""Session files: where a running emulator can be reached, and the secret that it asks for.

A file lies in the user's runtime directory, readable by its owner only, while the emulator runs
(:mod:`noack.io.held`).
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from pydantic import TypeAdapter, ValidationError

from noack.errors import CallerError, PeerError
from noack.io import held
from noack.io.private import require_name
from noack.mistakes import brief


class Session(NamedTuple):
    """How to reach an emulator."""

    name: str
    endpoint: str
    """zenoh endpoint, e.g. ``tcp/127.0.0.1:7447``."""
    token: str
    """The secret; see :mod:`netem.control.server`."""


_SESSION = TypeAdapter(Session)
_KIND = "netem"
_STARTING = "netem_starting"


def _path_of(name: str) -> Path:
    require_name(name, "emulator")
    return held.folder_of(_KIND) / f"{name}.json"


def make_folder() -> Path:
    """Make the folder that session files lie in, and return it.

    Raises:
        CallerError: it cannot be made, or others may look into it.
    """
    return held.make_folder(_KIND)


@contextmanager
def published(session: Session) -> Iterator[Path]:
    """Keep a session's file while the context lasts.

    Raises:
        CallerError: the name is unfit or in use, or the folder is not the user's own.
    """
    path = _path_of(session.name)
    make_folder()
    with ExitStack() as stack:
        try:
            stack.enter_context(held.held(path, session._asdict()))
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
            file = _path_of(name).name
            path = held.make_folder(_STARTING) / file
            try:
                stack.enter_context(held.held(path, {}))
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
    return sorted(path.stem for path in held.running(_KIND))


def find(name: str | None) -> Session:
    """Return the session of the named emulator, or of the only one that runs.

    Raises:
        CallerError: there is no such emulator, or there are several to choose from.
        PeerError: it is still starting, or its session file cannot be read.
    """
    names = running()
    begun = [path.stem for path in held.running(_STARTING)]
    if name not in names and (name in begun or (name is None and begun and not names)):
        raise PeerError(
            f"emulator {name or begun[0]!r} is starting; its first start compiles for some time, "
            "and it says `ready` on its standard output when it can be reached"
        )
    if not names:
        raise CallerError(
            ("no emulator" if name is None else f"no emulator {name!r}")
            + " runs that can be reached; start one with `noack netem --control NAME …`"
        )
    if name is None:
        if len(names) > 1:
            raise CallerError(f"which emulator? There are {', '.join(names)}")
        name = names[0]
    elif name not in names:
        raise CallerError(f"no emulator {name!r} runs; there are {', '.join(names)}")
    try:
        return _SESSION.validate_json(_path_of(name).read_bytes(), strict=True)
    except (OSError, ValidationError) as error:
        what = brief(error) if isinstance(error, ValidationError) else error.strerror
        raise PeerError(f"emulator {name!r}: its session file cannot be read: {what}") from None
