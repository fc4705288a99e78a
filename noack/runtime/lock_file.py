"""Lock files: each describes a running process and how to reach it, for its owner only.

They are in the user's runtime directory. The process holds a lock on its file, which the system
releases when the process ends. A file without a lock is stale, and the next reader removes it.
"""

import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

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
    FileExistsError if a running process has a file of this name.
    """
    with open_private(*_inside(kind), create=True) as folder:
        scratch, name = f"{name}.{secrets.token_hex(8)}", name + _SUFFIX
        with os.fdopen(folder.create(scratch), "w") as file:
            lock(file, wait=True)
            json.dump(content, file)
            file.flush()
            try:
                _put(folder, scratch, name)
            finally:
                folder.remove(scratch)
            try:
                yield folder.path / name
            finally:
                folder.remove_same(name, os.fstat(file.fileno()))


def live_lock_files(kind: str) -> list[LockFile]:
    """Return the lock files of a kind whose process runs, by name."""
    try:
        with open_private(*_inside(kind)) as folder:
            names = sorted(name for name in folder.names() if name.endswith(_SUFFIX))
            return [file for name in names if (file := _alive(folder, name)) is not None]
    except FileNotFoundError:
        return []


def _inside(kind: str) -> tuple[str, ...]:
    return (kind,) if kind else ()


def _put(folder: PrivateFolder, scratch: str, name: str) -> None:
    for attempt in range(2):
        try:
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
        if not lock(file):
            return LockFile(folder.path / name, file.read())
        folder.remove_same(name, status)
    return None
