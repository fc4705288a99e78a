"""Files that tell of something that runs, and can be reached: its owner's alone, while it runs.

They lie in the user's runtime directory. Whoever puts one there holds a lock on it, which the
system releases however that process ends; a file without a lock is of one that died, and is removed
by whoever finds it.
"""

import fcntl
import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from noack.io.private import make_private, private_folder, require_private


def folder_of(kind: str) -> Path:
    """Where the files of a kind lie; the folder need not exist yet."""
    return private_folder() / kind


def make_folder(kind: str) -> Path:
    """Make the folder that files of a kind lie in, and return it.

    Raises:
        CallerError: it cannot be made, or others may look into it.
    """
    folder = folder_of(kind)
    make_private(folder.parent)
    make_private(folder)
    return folder


@contextmanager
def held(path: Path, content: Mapping[str, object]) -> Iterator[Path]:
    """Keep a file while the context lasts.

    Args:
        path: where, in a folder from :func:`make_folder`.
        content: what it says, as JSON.

    Raises:
        FileExistsError: one that runs has a file of this name.
    """
    scratch = path.with_suffix(f".{secrets.token_hex(8)}")
    descriptor = os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        json.dump(content, file)
        file.flush()
        try:
            _put(scratch, path)
        finally:
            scratch.unlink()
        try:
            yield path
        finally:
            _remove(path, os.fstat(descriptor))


def running(kind: str) -> list[Path]:
    """Return the files of a kind whose owner runs.

    Raises:
        CallerError: the folder is open to others.
    """
    folder = folder_of(kind)
    if not folder.exists():
        return []
    require_private(folder)
    return sorted(path for path in folder.glob("*.json") if _alive(path))


def _put(scratch: Path, path: Path) -> None:
    """Give the file its name, unless one that runs has it."""
    for attempt in range(2):
        try:
            os.link(scratch, path)
            return
        except FileExistsError:
            if attempt or _alive(path):
                raise


def _remove(path: Path, status: os.stat_result) -> None:
    """Remove a file unless another has taken its place."""
    try:
        if os.path.samestat(path.stat(), status):
            path.unlink()
    except FileNotFoundError:
        pass


def _alive(path: Path) -> bool:
    """Whether the owner of a file runs; the file of one that does not is removed."""
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
