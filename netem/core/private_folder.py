"""The user's runtime directory: files that only their owner can read, and lock files among them.

Without ``XDG_RUNTIME_DIR`` it is in a folder where all users may write. So each folder is opened
once, the open descriptor is checked, and files are reached through it: another user who replaces
the folder by his own, or by a link, replaces nothing that is in use.

A lock file describes a running process and how to reach it. The process holds a lock on its file,
which the system releases when the process ends. A file without a lock is stale, and the next reader
removes it, and what is left of the process's socket and token. Readers share their lock. Whoever
adds or removes a name locks the folder meanwhile, so that the socket of a new process of this name
is not removed.
"""

import json
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from netem.core.errors import CallerError, MachineError, why
from netem.core.file_access import lock, open_folder

_SUFFIX = ".json"
_BESIDE = (".sock", ".sock.lock", ".token")
"""Suffixes of what a process has beside its lock file: a socket, zenoh's lock of it, a token."""


def private_folder() -> Path:
    """Return the folder of the user's private files; it need not exist yet."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    return Path(base or tempfile.gettempdir()) / f"noack-{os.getuid()}"


def require_name(name: str, kind: str) -> None:
    """Raise CallerError unless a name is fit for a file."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", name):
        raise CallerError(f"{kind} {name!r}: use letters, digits, _ and -, at most 64")


class PrivateFolder:
    """An open folder that belongs to the user and is closed to others.

    ``descriptor`` can be given to functions of :mod:`os` as ``dir_fd``.
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path, self.descriptor = path, descriptor

    def create(self, name: str) -> int:
        """Create a file for writing, replacing any of this name; return its descriptor."""
        with suppress(FileNotFoundError):
            self.remove(name)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        return os.open(name, flags, 0o600, dir_fd=self.descriptor)

    def open(self, name: str) -> int:
        """Open a file for reading; return its descriptor.

        Raise CallerError if it is not a file of the user's, FileNotFoundError if there is none.
        """
        flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            descriptor = os.open(name, flags, dir_fd=self.descriptor)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise CallerError(f"{self.path / name}: cannot be read ({error.strerror})") from None
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode) or status.st_uid != os.getuid():
            os.close(descriptor)
            raise CallerError(f"{self.path / name}: must be a file of yours")
        return descriptor

    def names(self) -> list[str]:
        """Return the names of all files."""
        return os.listdir(self.descriptor)  # noqa: PTH208 - a Path has no descriptor

    def link(self, name: str, second_name: str) -> None:
        """Give a file a second name; raise FileExistsError if that exists."""
        os.link(name, second_name, src_dir_fd=self.descriptor, dst_dir_fd=self.descriptor)

    def remove(self, name: str) -> None:
        """Remove a file; raise FileNotFoundError if there is none."""
        os.unlink(name, dir_fd=self.descriptor)

    def remove_same(self, name: str, status: os.stat_result) -> bool:
        """Remove a file unless it was replaced; return whether it was removed."""
        with suppress(FileNotFoundError):
            current = os.stat(name, dir_fd=self.descriptor, follow_symlinks=False)
            if os.path.samestat(current, status):
                self.remove(name)
                return True
        return False


@contextmanager
def open_private(*inside: str, create: bool = False) -> Iterator[PrivateFolder]:
    """Open the user's private folder, or nested folders ``inside`` it, while the context lasts.

    Raise CallerError if a folder cannot be created, belongs to another user, is a link, or is open
    to others; FileNotFoundError if it does not exist and ``create`` is false.
    """
    path = private_folder()
    if not path.parent.is_dir():
        raise CallerError(f"{path.parent}: no such folder; set XDG_RUNTIME_DIR to a folder of yours")
    with ExitStack() as stack:
        try:
            descriptor = stack.enter_context(open_folder(path.parent)).descriptor
        except OSError as error:
            raise CallerError(f"{path.parent}: {why(error)}") from None
        for folder in (path, *(path := path / name for name in inside)):
            descriptor = _open_folder(folder, descriptor, create=create)
            stack.callback(os.close, descriptor)
        assert descriptor is not None
        yield PrivateFolder(path, descriptor)


def _open_folder(path: Path, parent: int | None, *, create: bool) -> int:
    if create:
        try:
            os.mkdir(path.name, 0o700, dir_fd=parent)
        except FileExistsError:
            pass
        except OSError as error:
            raise CallerError(f"{path}: cannot be made ({error.strerror})") from None
    wrong = CallerError(f"{path}: must be a folder of yours, no link, closed to others (mode 700)")
    flags = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        descriptor = os.open(path.name, flags, dir_fd=parent)
    except FileNotFoundError:
        raise
    except OSError:  # a link, no folder, or one that we may not read
        raise wrong from None
    status = os.fstat(descriptor)
    if status.st_uid != os.getuid() or status.st_mode & 0o077:
        os.close(descriptor)
        raise wrong
    return descriptor


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
                _replace_file(folder, scratch, name)
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


def live_lock_files(kind: str, only_name: str = "") -> list[LockFile]:
    """Return the lock files of a kind, or only that of a name, whose process runs, by name."""
    try:
        with open_private(*_inside(kind)) as folder:
            candidates = [only_name + _SUFFIX] if only_name else sorted(folder.names())
            names = [name for name in candidates if name.endswith(_SUFFIX)]
            return [file for name in names if (file := _live_file(folder, name)) is not None]
    except FileNotFoundError:
        return []


def _inside(kind: str) -> tuple[str, ...]:
    return (kind,) if kind else ()


def _replace_file(folder: PrivateFolder, scratch: str, name: str) -> None:
    for attempt in range(2):
        try:
            with _locked(folder):
                folder.link(scratch, name)
            return
        except FileExistsError:
            if attempt or _live_file(folder, name) is not None:
                raise


def _live_file(folder: PrivateFolder, name: str) -> LockFile | None:
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
    """Remove a file, and what is left of its process's socket and token, unless it was replaced."""
    with _locked(folder):
        if folder.remove_same(name, status):
            for suffix in _BESIDE:
                with suppress(FileNotFoundError):
                    folder.remove(name.removesuffix(_SUFFIX) + suffix)


@contextmanager
def _locked(folder: PrivateFolder) -> Iterator[None]:
    descriptor = os.open(".", os.O_RDONLY | os.O_CLOEXEC, dir_fd=folder.descriptor)
    try:
        lock(descriptor, wait=True)
        yield
    finally:
        os.close(descriptor)
