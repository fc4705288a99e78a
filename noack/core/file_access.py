"""Files: atomic writing, reading of limited size, and advisory locks."""

import fcntl
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from noack.core.errors import CallerError, MachineError, printable, why

SCRATCH = ".partial"
"""Suffix of a file that is being written."""
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


def require_suffix(path: Path, option: str, suffix: str) -> None:
    """Raise CallerError if the name of a file to be written, given by an option, ends otherwise."""
    if path.suffix != suffix:
        raise CallerError(f"{option} {path}: the file's name must end in {suffix}")


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Yield a new file, which replaces ``path`` in one step at the end of the context.

    If an exception ends the context, the new file is removed and ``path`` stays. The new file has a
    random name beside ``path`` and is not a link, whatever other users have made in the folder.

    Raises:
        OSError: the file cannot be written.
        ValueError: ``path`` is a folder or a device, which would be replaced too, or no name of a
            file.

    >>> with replacing(Path("results.csv")) as file:
    ...     _ = file.write(b"events,20")
    """
    if path.exists() and not path.is_file():
        raise ValueError("not a regular file")
    scratch = path.parent / f".{secrets.token_hex(8)}{SCRATCH}"
    descriptor = os.open(scratch, _NEW_FILE, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
        scratch.replace(path)
    except BaseException:
        scratch.unlink(missing_ok=True)
        raise


def write_whole(path: Path, content: str | bytes, *, make_folder: bool = True) -> Path:
    """Write a file, or replace it, in one step; return its path. See :func:`replacing`.

    Text is written as UTF-8. Missing folders are created with ``make_folder``. Raise MachineError
    if the file cannot be written, or is a folder or a device.
    """
    try:
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(content.encode() if isinstance(content, str) else content)
    except (OSError, ValueError) as error:  # ValueError also: a name that no file can have
        raise MachineError(printable(f"{path}: cannot be written: {why(error)}")) from None
    return path


@contextmanager
def open_regular(path: Path) -> Iterator[IO[bytes]]:
    """Open a regular file; raise ValueError if it is a device, a FIFO or a directory."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # so that a FIFO does not block
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError("not a regular file")
        with open(descriptor, "rb", closefd=False) as file:
            yield file
    finally:
        os.close(descriptor)


def read_regular(path: Path, most_bytes: int) -> bytes:
    """Return the bytes of a regular file.

    Raise ValueError if it is a device, a FIFO or a directory, or larger than ``most_bytes``.
    """
    with open_regular(path) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise ValueError(f"larger than {most_bytes // 2**20} MiB")
    return content


def lock(file: int | IO[Any], *, shared: bool = False, wait: bool = False) -> bool:
    """Lock an open file or folder until it is closed; return False if another process has the lock.

    ``shared`` locks exclude only exclusive ones. With ``wait`` it waits for the other processes.
    Raise OSError if the file system does not support locks.
    """
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(file, kind if wait else kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def locked(path: Path, *, shared: bool = False, wait: bool = False) -> Iterator[bool]:
    """Lock a file, which is created if missing, while the context lasts; yields :func:`lock`."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK
    with os.fdopen(os.open(path, flags, 0o666), "rb") as file:
        yield lock(file, shared=shared, wait=wait)
