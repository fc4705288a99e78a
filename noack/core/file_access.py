"""Files: atomic writing, reading of limited size, and advisory locks."""

import errno
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import IO, NamedTuple

from noack.core.errors import CallerError, MachineError, printable, why
from noack.core.extension_points import parts

with suppress(ImportError):  # Windows has other locks
    import fcntl

PARTIAL = ".partial"
"""End of the names of files that are being written; they begin with a dot."""
_NOT_REGULAR = "not a regular file"
_HAS_LINKS = os.open in os.supports_dir_fd
"""Whether other users can put links into a folder (POSIX). On Windows links need their privilege,
and a folder has no descriptor, nor can an open file be replaced."""
_UNBLOCKED_FLAGS = os.O_NONBLOCK if _HAS_LINKS else os.O_BINARY  # type: ignore[attr-defined]
_SAFE_FLAGS = _UNBLOCKED_FLAGS | (os.O_NOFOLLOW | os.O_CLOEXEC if _HAS_LINKS else 0)
"""Follow no link, and do not wait for the reader of a FIFO."""


@cache
def shipped_files(kind: str) -> Mapping[str, Path]:
    """Return the TOML files that come with noack and its extensions by their names, sorted.

    Those of noack are in the package, or in the repository, those of an extension beside a module.

    Args:
        kind: scenarios or campaigns.
    """

    def folder_of(module: ModuleType) -> Path | None:
        return Path(module.__file__).parent if module.__file__ else None

    root = Path(__file__).parents[2]
    packaged = root / "cosim" / kind
    own = packaged if packaged.is_dir() else root / kind
    folders = [*parts(None, f"noack.{kind}", folder_of), own]  # noack's own last, which win
    files = {file.stem: file for folder in folders for file in folder.glob("*.toml")}
    return dict(sorted(files.items()))


def require_suffix(path: Path, option: str, suffix: str) -> None:
    """Raise CallerError if the name of a file to be written, given by an option, ends otherwise."""
    if path.suffix != suffix:
        raise CallerError(f"{option} {path}: the file's name must end in {suffix}")


def write_whole(path: Path, content: str | bytes, *, make_folder: bool = True) -> Path:
    """Write a file, or replace it, in one step; return its path.

    Text is written as UTF-8. Raise MachineError if :func:`new_file` fails.
    """
    try:
        with new_file(path, make_folder=make_folder) as file:
            file.write(content.encode() if isinstance(content, str) else content)
    except (OSError, ValueError) as error:
        raise MachineError(printable(f"{path}: cannot be written: {why(error)}")) from None
    return path


@contextmanager
def new_file(path: Path, *, make_folder: bool = True, mode: int = 0o666) -> Iterator[IO[bytes]]:
    """Open a file that appears under its name at the end; after an error, nothing is left of it.

    Until then it has a random name in the same folder, where another user of the folder cannot have
    put a link. An existing file, or a link, is replaced. Missing folders are created with
    ``make_folder``. The umask applies to ``mode``. Raise OSError or ValueError if it cannot be
    written, or the path is that of a folder, a FIFO or a device, which would be replaced too; or
    its folder is a link of another user.
    """
    if path.exists() and not path.is_file():
        raise OSError(_NOT_REGULAR)
    if make_folder:
        path.parent.mkdir(parents=True, exist_ok=True)
    with _folder(path.parent) as folder:
        scratch, descriptor = _scratch_file(folder, mode)
        try:
            with os.fdopen(descriptor, "wb") as file:
                yield file
            folder.replace(scratch, path.name)
        except BaseException:
            with suppress(OSError):
                os.unlink(folder.at / scratch, dir_fd=folder.descriptor)
            raise


def open_growing(path: Path, *, follow: bool = False) -> int:
    """Open an empty file that has its name while it is written; return its descriptor.

    A file of the user's own is overwritten. A link, another user's file, and a file with several
    names is replaced. With ``follow``, a FIFO, a device or a link that is the user's own or root's
    (``/dev/stdout``) is opened as it is. Raise OSError or ValueError if it cannot be written, or is
    a folder, or a FIFO or a device without ``follow``, or another user's; or its folder is a link
    of another user.
    """
    if not _HAS_LINKS:
        return _open_regular(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    flags = os.O_WRONLY | os.O_CLOEXEC
    with suppress(FileNotFoundError):
        status = path.lstat()
        is_link = stat.S_ISLNK(status.st_mode)
        if stat.S_ISREG(status.st_mode):
            if status.st_uid == os.geteuid() and status.st_nlink == 1:
                descriptor = _open_alone(path, flags)
                os.ftruncate(descriptor, 0)
                return descriptor
        elif follow and _is_trusted(status):
            flags |= os.O_CREAT | os.O_TRUNC if is_link else os.O_NOFOLLOW
            return os.open(path, flags, 0o666)
        elif not is_link:
            raise OSError(_NOT_REGULAR)
    with _folder(path.parent) as folder:
        scratch, descriptor = _scratch_file(folder, 0o666)
        try:
            folder.replace(scratch, path.name)
        except BaseException:
            os.close(descriptor)
            os.unlink(folder.at / scratch, dir_fd=folder.descriptor)
            raise
    return descriptor


def open_append(path: Path) -> int:
    """Open a file, which is created if missing, to append to it; return its descriptor.

    Raise OSError if it cannot be written, or is a link, has several names, or is no regular file.
    """
    return _open_alone(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)


def copy_whole(source: Path, target: Path) -> None:
    """Copy a regular file as :func:`new_file` writes; raise OSError or ValueError.

    The copy of a program that its owner may run can be run, too.
    """
    with open_regular(source) as content, new_file(target, make_folder=False) as file:
        shutil.copyfileobj(content, file)
        mode = os.fstat(file.fileno()).st_mode
        os.fchmod(file.fileno(), mode | os.fstat(content.fileno()).st_mode & 0o100)


def remove_folder(path: Path) -> None:
    """Remove a folder and what is in it; follow no link of another user. Errors are ignored."""
    with suppress(OSError), _folder(path.parent) as folder:
        shutil.rmtree(folder.at / path.name, ignore_errors=True, dir_fd=folder.descriptor)


def _open_alone(path: Path, flags: int) -> int:
    """Open a regular file that has one name, without following a link."""
    descriptor = _open_regular(path, flags)
    if os.fstat(descriptor).st_nlink > 1:
        os.close(descriptor)
        raise OSError("a hard link to another file")
    return descriptor


def _open_regular(path: Path, flags: int) -> int:
    """Open a regular file; follow no link, and do not wait for the reader of a FIFO."""
    try:
        with _folder(path.parent) as folder:
            descriptor = folder.open(path.name, flags | _SAFE_FLAGS, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):
            raise OSError(_NOT_REGULAR) from None
        error.filename = str(path)
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(_NOT_REGULAR)
    return descriptor


class _Folder(NamedTuple):
    """A folder: its descriptor, to which names are relative, or its path where there is none."""

    at: Path
    descriptor: int | None

    def open(self, name: str, flags: int, mode: int) -> int:
        return os.open(self.at / name, flags, mode, dir_fd=self.descriptor)

    def replace(self, name: str, other: str) -> None:
        at, folder = self.at, self.descriptor
        os.replace(at / name, at / other, src_dir_fd=folder, dst_dir_fd=folder)


def _scratch_file(folder: _Folder, mode: int) -> tuple[str, int]:
    """Create a file with a random name in an open folder; return its name and descriptor."""
    name = f".{os.urandom(8).hex()}{PARTIAL}"
    return name, folder.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _SAFE_FLAGS, mode)


@contextmanager
def _folder(path: Path) -> Iterator[_Folder]:
    """Open a folder; raise OSError if it is a symbolic link that another user has made."""
    if not _HAS_LINKS:
        yield _Folder(path, None)
        return
    flags = os.O_DIRECTORY | os.O_CLOEXEC | getattr(os, "O_PATH", os.O_RDONLY)
    if path.is_symlink() and _is_trusted(path.lstat()):
        descriptor = os.open(path, flags)
    else:
        try:
            descriptor = os.open(path, flags | os.O_NOFOLLOW)
        except NotADirectoryError:
            if path.is_symlink():
                raise OSError(f"{path} is a symbolic link of another user") from None
            raise
    try:
        yield _Folder(Path(), descriptor)
    finally:
        os.close(descriptor)


def _is_trusted(status: os.stat_result) -> bool:
    """Whether a link, FIFO or device was made by the user or by root."""
    return status.st_uid in (0, os.geteuid())


@contextmanager
def open_regular(path: Path) -> Iterator[IO[bytes]]:
    """Open a regular file; raise ValueError if it is a device, a FIFO or a directory."""
    descriptor = os.open(path, os.O_RDONLY | _UNBLOCKED_FLAGS)  # so that a FIFO does not block
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise ValueError(_NOT_REGULAR)
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


def lock(file: int | IO[bytes], *, shared: bool = False, wait: bool = False) -> bool:
    """Lock an open file or folder until it is closed; return False if another process has the lock.

    ``shared`` locks exclude only exclusive ones. With ``wait`` it waits for the other processes.
    Raise OSError if the file system does not support locks. Without locks (Windows) it is True.
    """
    if "fcntl" not in globals():
        return True
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    try:
        fcntl.flock(file, kind if wait else kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def locked(path: Path, *, shared: bool = False, wait: bool = False) -> Iterator[bool]:
    """Lock a file, which is created if missing, while the context lasts; yields :func:`lock`.

    Raise OSError if it cannot be opened, is a link, or is no regular file.
    """
    descriptor = _open_regular(path, os.O_WRONLY | os.O_CREAT)
    try:
        yield lock(descriptor, shared=shared, wait=wait)
    finally:
        os.close(descriptor)
