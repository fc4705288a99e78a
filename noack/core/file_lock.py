"""Advisory locks on files and folders; the system releases them when their process ends."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol


class _Descriptor(Protocol):
    def fileno(self) -> int: ...


def lock(file: int | _Descriptor, *, shared: bool = False, wait: bool = False) -> bool:
    """Lock an open file or folder until it is closed; return False if another process has the lock.

    ``shared`` locks exclude only exclusive ones. With ``wait`` it waits for the other processes.

    Raises:
        OSError: the file system does not support locks.
    """
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(file, kind if wait else kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def locked(path: Path, *, shared: bool = False, wait: bool = False) -> Iterator[bool]:
    """Lock a file, which is created if missing, while the context lasts; yields :func:`lock`.

    Raises:
        OSError: the file cannot be opened or locked.
    """
    with path.open("a") as file:
        yield lock(file, shared=shared, wait=wait)
