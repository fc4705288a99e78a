"""Support for native code of third parties: a folder to unpack it in, and suppressed output."""

import ctypes
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from noack.core.file_access import lock

_PREFIX = "noack-native-"
_STREAMS = (1, 2)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Create a folder for this user only and remove it at the end; remove abandoned folders first.

    A lock marks a folder that is in use. The lock ends with its process, even if that process is
    killed; a folder without a lock is abandoned.
    """
    for left in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        _remove_if_left(left)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
        lock = _locked(folder)
        if lock is not None and folder.is_dir():
            break
        if lock is not None:  # another process removed it before it was locked
            os.close(lock)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)


def _remove_if_left(folder: Path) -> None:
    with suppress(OSError):
        if folder.lstat().st_uid != os.getuid():
            return
        lock = _locked(folder)
        if lock is not None:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(lock)


def _locked(folder: Path) -> int | None:
    """Lock a folder; return its descriptor, None if another holds a lock or there is no folder."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    with suppress(OSError):
        if lock(descriptor):
            return descriptor
    os.close(descriptor)
    return None


@contextmanager
def quiet() -> Iterator[None]:
    """Discard all output that native code prints in this context; it may print at every step."""
    kept = []
    with suppress(OSError):  # a stream that is closed stays closed
        for stream in _STREAMS:
            kept.append((stream, os.dup(stream)))  # noqa: PERF401
    null = os.open(os.devnull, os.O_WRONLY)
    for stream, _ in kept:
        os.dup2(null, stream)
    os.close(null)
    try:
        yield
    finally:
        _LIBC.fflush(None)  # otherwise its buffer is printed later
        for stream, copy in kept:
            os.dup2(copy, stream)
            os.close(copy)


_LIBC = ctypes.CDLL(None)
