"""Lock files: each describes a running process and how to reach it, for its owner only.

They are in the user's runtime directory. The process holds a lock on its file, which the system
releases when the process ends. A file without a lock is stale, and the next reader removes it, and
what zenoh left of the process's socket. Readers share their lock. Whoever gives or removes a name
locks the folder meanwhile: the socket that is removed is not that of a new process of this name.
"""

import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from noack.core.errors import MachineError, why
from noack.core.file_access import lock
from noack.runtime.private_folder import PrivateFolder, open_private

_SUFFIX = ".json"


class LockFile(NamedTuple):
    """A file whose process runs."""

    path: Path
    content: bytes


@contextmanager
def lock_file(kind: str, name: str, content: Mapping[str, object]) -> Iterator[Path]:
    """Keep a lock file with this content, as JSON, while the context lasts.

    It is in the folder ``kind`` of the runtime directory; "" is the directory itself. Raise
    FileExistsError if a running process has a file of this name, MachineError if it cannot be
    written.
    """
    with open_private(*_inside(kind), create=True) as folder, ExitStack() as stack:
        scratch, name = f"{name}.{secrets.token_hex(8)}", name + _SUFFIX
        try:
            descriptor = folder.create(scratch)
            stack.callback(os.close, descriptor)
            try:
                lock(descriptor, wait=True)
                with open(descriptor, "w", closefd=False) as file:
                    json.dump(content, file)
                _put(folder, scratch, name)
            finally:
                folder.remove(scratch)
        except FileExistsError:
            raise
        except OSError as error:
            raise MachineError(f"{folder.path / name}: cannot be written: {why(error)}") from None
        try:
            yield folder.path / name
        finally:
            _remove(folder, name, os.fstat(descriptor))


def live_lock_files(kind: str) -> list[LockFile]:
    """Return the lock files of a kind whose process runs, by name."""
    try:
        with open_private(*_inside(kind)) as folder:
            names = sorted(name for name in folder.names() if name.endswith(_SUFFIX))
            return [file for name in names if (file := _alive(folder, name)) is not None]
    except FileNotFoundError:
        return []


def live_lock_file(kind: str, name: str) -> LockFile | None:
    """Return the lock file of this name; None if there is none whose process runs."""
    try:
        with open_private(*_inside(kind)) as folder:
            return _alive(folder, name + _SUFFIX)
    except FileNotFoundError:
        return None


def _inside(kind: str) -> tuple[str, ...]:
    return (kind,) if kind else ()


def _put(folder: PrivateFolder, scratch: str, name: str) -> None:
    for attempt in range(2):
        try:
            with _locked(folder):
                folder.link(scratch, name)
            return
        except FileExistsError:
            if attempt or _alive(folder, name) is not None:
                raise


def _alive(folder: PrivateFolder, name: str) -> LockFile | None:
    """Return a file if its process runs; remove it otherwise."""
    try:
        descriptor = folder.open(name)
    except FileNotFoundError:
        return None
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(file.fileno())
        if not lock(file, shared=True):
            return LockFile(folder.path / name, file.read())
        _remove(folder, name, status)
    return None


def _remove(folder: PrivateFolder, name: str, status: os.stat_result) -> None:
    """Remove a file, and what is left of its process's socket, unless it was replaced."""
    with _locked(folder):
        if folder.remove_same(name, status):
            for left in (socket := name.removesuffix(_SUFFIX) + ".sock", f"{socket}.lock"):
                with suppress(FileNotFoundError):
                    folder.remove(left)


@contextmanager
def _locked(folder: PrivateFolder) -> Iterator[None]:
    descriptor = os.open(".", os.O_RDONLY | os.O_CLOEXEC, dir_fd=folder.descriptor)
    try:
        lock(descriptor, wait=True)
        yield
    finally:
        os.close(descriptor)
