"""Session files: where a running emulator can be reached, and the secret that it asks for.

A file lies in the user's runtime directory, readable by its owner only, while the emulator runs.
The emulator holds a lock on it, which the system releases however the emulator ends; a file without
a lock is of one that died, and is removed by whoever finds it.
"""

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from pydantic import TypeAdapter, ValidationError

from noack.errors import CallerError, PeerError
from noack.io.private import make_private, private_folder, require_name, require_private
from noack.mistakes import brief


class Session(NamedTuple):
    """How to reach an emulator."""

    name: str
    endpoint: str
    """zenoh endpoint, e.g. ``tcp/127.0.0.1:7447``."""
    token: str
    """The secret; see :mod:`netem.control.server`."""


_SESSION = TypeAdapter(Session)


def _folder() -> Path:
    return private_folder() / "netem"


def _path_of(name: str) -> Path:
    require_name(name, "emulator")
    return _folder() / f"{name}.json"


def make_folder() -> Path:
    """Make the folder that session files lie in, and return it.

    Raises:
        CallerError: it cannot be made, or others may look into it.
    """
    make_private(_folder().parent)
    make_private(_folder())
    return _folder()


@contextmanager
def published(session: Session) -> Iterator[Path]:
    """Keep a session's file while the context lasts.

    Raises:
        CallerError: the name is unfit or in use, or the folder is not the user's own.
    """
    path = _path_of(session.name)
    scratch = make_folder() / f"{session.name}.{os.getpid()}"
    descriptor = os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        json.dump(session._asdict(), file)
        file.flush()
        try:
            _put(scratch, path, session.name)
        finally:
            scratch.unlink()
        try:
            yield path
        finally:
            _remove(path, os.fstat(descriptor))


def _put(scratch: Path, path: Path, name: str) -> None:
    """Give the file its name, unless a running emulator has it."""
    for attempt in range(2):
        try:
            os.link(scratch, path)
            return
        except FileExistsError:
            if attempt or _alive(path):
                break
    raise CallerError(f"--control {name}: an emulator of this name runs; choose another name")


def _remove(path: Path, status: os.stat_result) -> None:
    """Remove a file unless another has taken its place."""
    try:
        if os.path.samestat(path.stat(), status):
            path.unlink()
    except FileNotFoundError:
        pass


def _alive(path: Path) -> bool:
    """Whether the emulator of a session file runs; the file of one that does not is removed."""
    try:
        with path.open() as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
            _remove(path, os.fstat(file.fileno()))
    except FileNotFoundError:
        pass
    return False


def running() -> list[str]:
    """Return the names of the emulators of this user that can be reached.

    Raises:
        CallerError: the folder is open to others.
    """
    if not _folder().exists():
        return []
    require_private(_folder())
    return sorted(path.stem for path in _folder().glob("*.json") if _alive(path))


def find(name: str | None) -> Session:
    """Return the session of the named emulator, or of the only one that runs.

    Raises:
        CallerError: there is no such emulator, or there are several to choose from.
        PeerError: its session file cannot be read.
    """
    names = running()
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
