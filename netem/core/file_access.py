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

from netem.core.errors import CallerError, MachineError, printable, why
from netem.core.extension_points import parts

with suppress(ImportError):  # Windows has other locks
    import fcntl

PARTIAL = ".partial"
"""End of the names of files that are being written; they begin with a dot."""
_NOT_REGULAR = "not a regular file"
_MOST_LINKS = 40
"""Maximum number of links on the way to a folder, as in Linux."""
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
    a folder on the way is a link of another user.
    """
    with open_folder(path.parent, make=make_folder) as folder:
        if path.exists() and not path.is_file():
            raise OSError(_NOT_REGULAR)
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
    a folder, or a FIFO or a device without ``follow``, or another user's; or a folder on the way is
    a link of another user.
    """
    if not _HAS_LINKS:
        return _open_regular(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    with open_folder(path.parent) as folder:
        with suppress(FileNotFoundError):
            status = os.stat(path.name, dir_fd=folder.descriptor, follow_symlinks=False)
            is_link = stat.S_ISLNK(status.st_mode)
            if stat.S_ISREG(status.st_mode):
                if status.st_uid == os.geteuid() and status.st_nlink == 1:
                    descriptor = _open_alone(path, os.O_WRONLY)
                    os.ftruncate(descriptor, 0)
                    return descriptor
            elif follow and _is_trusted(status):
                return _open_special(folder, path, is_link=is_link)
            elif not is_link:
                raise OSError(_NOT_REGULAR)
        scratch, descriptor = _scratch_file(folder, 0o666)
        try:
            folder.replace(scratch, path.name)
        except BaseException:
            os.close(descriptor)
            os.unlink(folder.at / scratch, dir_fd=folder.descriptor)
            raise
    return descriptor


def _open_special(folder: "Folder", path: Path, *, is_link: bool) -> int:
    """Open a FIFO or a device, or what a link of the user or of root leads to."""
    flags = os.O_WRONLY | os.O_CLOEXEC
    if not is_link:
        return folder.open(path.name, flags | os.O_NOFOLLOW, 0o666)
    if _is_of_proc(folder):  # /dev/stdout: an open file, which has no path
        return folder.open(path.name, flags, 0o666)
    target = path.parent / os.readlink(path.name, dir_fd=folder.descriptor)
    with suppress(FileNotFoundError):
        path.stat()  # raises OSError if links lead in a circle
        if not stat.S_ISREG(target.lstat().st_mode):
            return open_growing(target, follow=True)
    return _open_regular(target, flags | os.O_CREAT | os.O_TRUNC)


def _is_of_proc(folder: "Folder") -> bool:
    """Whether an open folder is one of the system's, with links to open files."""
    proc = Path("/proc")
    return (
        folder.descriptor is not None
        and proc.is_dir()
        and proc.stat().st_dev == os.fstat(folder.descriptor).st_dev
    )


def open_append(path: Path) -> int:
    """Open a file, which is created if missing, to append to it; return its descriptor.

    Raise OSError if it cannot be written, or is a link, has several names, or is no regular file.
    """
    return _open_alone(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)


def create_file(path: Path, mode: int = 0o666) -> int:
    """Create an empty file, and missing folders above it; return its descriptor.

    The umask applies to ``mode``. Raise FileExistsError if there is something of this name, OSError
    if it cannot be created.
    """
    with open_folder(path.parent, make=True) as folder:
        return folder.open(path.name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _SAFE_FLAGS, mode)


def copy_whole(source: Path, target: Path) -> None:
    """Copy a regular file as :func:`new_file` writes; raise OSError or ValueError.

    The copy of a program that its owner may run can be run, too.
    """
    with open_regular(source) as content, new_file(target, make_folder=False) as file:
        shutil.copyfileobj(content, file)
        mode = os.fstat(file.fileno()).st_mode
        os.fchmod(file.fileno(), mode | os.fstat(content.fileno()).st_mode & 0o100)


def create_folder(path: Path, *, exist_ok: bool = True, mode: int = 0o777) -> None:
    """Create a folder; raise OSError if that is impossible, or a link of another user is on the way.

    The umask applies to ``mode``. Missing folders above it are created only with ``exist_ok``.
    """
    with open_folder(path.parent, make=exist_ok) as folder:
        try:
            os.mkdir(folder.at / path.name, mode, dir_fd=folder.descriptor)
        except FileExistsError:
            if not exist_ok:
                raise
            with open_folder(path):
                pass


def move(path: Path, new_path: Path) -> Path:
    """Rename a file or folder, which may replace a file; follow no link of another user."""
    with open_folder(path.parent) as folder, open_folder(new_path.parent) as new_folder:
        source, target = folder.at / path.name, new_folder.at / new_path.name
        os.replace(source, target, src_dir_fd=folder.descriptor, dst_dir_fd=new_folder.descriptor)
    return new_path


def write_link(path: Path, target: str) -> None:
    """Write a symbolic link, or replace a link or a file by it, in one step; raise OSError."""
    scratch = f".{os.urandom(8).hex()}{PARTIAL}"
    with open_folder(path.parent) as folder:
        os.symlink(target, folder.at / scratch, dir_fd=folder.descriptor)
        try:
            folder.replace(scratch, path.name)
        except BaseException:
            os.unlink(folder.at / scratch, dir_fd=folder.descriptor)
            raise


def remove_file(path: Path) -> None:
    """Remove a file if it exists; follow no link of another user."""
    with suppress(FileNotFoundError), open_folder(path.parent) as folder:
        os.unlink(folder.at / path.name, dir_fd=folder.descriptor)


def remove_folder(path: Path) -> None:
    """Remove a folder and what is in it; follow no link of another user. Errors are ignored."""
    with suppress(OSError), open_folder(path.parent) as folder:
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
        with open_folder(path.parent) as folder:
            descriptor = folder.open(path.name, flags | _SAFE_FLAGS, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):
            raise OSError(_NOT_REGULAR) from None
        if error.errno is not None:
            error.filename = str(path)
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(_NOT_REGULAR)
    return descriptor


class Folder(NamedTuple):
    """A folder: its descriptor, to which names are relative, or its path where there is none."""

    at: Path
    descriptor: int | None

    def open(self, name: str, flags: int, mode: int) -> int:
        """Open a file in it; return its descriptor."""
        return os.open(self.at / name, flags, mode, dir_fd=self.descriptor)

    def replace(self, name: str, other: str) -> None:
        """Rename a file in it."""
        at, folder = self.at, self.descriptor
        os.replace(at / name, at / other, src_dir_fd=folder, dst_dir_fd=folder)


def _scratch_file(folder: Folder, mode: int) -> tuple[str, int]:
    """Create a file with a random name in an open folder; return its name and descriptor."""
    name = f".{os.urandom(8).hex()}{PARTIAL}"
    return name, folder.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _SAFE_FLAGS, mode)


@contextmanager
def open_folder(path: Path, *, make: bool = False) -> Iterator[Folder]:
    """Open the folder of an output, component by component, while the context lasts.

    Links of the user and of root are followed. Missing folders are created with ``make``. Raise
    OSError if a folder on the way is a symbolic link of another user, who chooses where it leads.
    """
    if not _HAS_LINKS:
        if make:
            path.mkdir(parents=True, exist_ok=True)
        yield Folder(path, None)
        return
    descriptor = _walk(path, make=make)
    try:
        yield Folder(Path(), descriptor)
    finally:
        os.close(descriptor)


def _walk(path: Path, *, make: bool) -> int:
    """Open a folder as :func:`open_folder` says; return its descriptor."""
    flags = os.O_DIRECTORY | os.O_CLOEXEC | getattr(os, "O_PATH", os.O_RDONLY)
    descriptor, links, reached = os.open(".", flags), 0, Path()
    names = list(reversed(path.parts))  # the root folder is a part, too
    try:
        while names:
            name = names.pop()
            target = _target_of_link(reached / name, descriptor)
            if target is not None:
                links += 1
                if links > _MOST_LINKS:
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
                names += reversed(target.parts)
                continue
            if make:
                with suppress(FileExistsError):
                    os.mkdir(name, dir_fd=descriptor)
            inner = os.open(name, flags | os.O_NOFOLLOW, dir_fd=descriptor)
            os.close(descriptor)
            descriptor, reached = inner, reached / name
    except BaseException as error:
        os.close(descriptor)
        if isinstance(error, OSError) and error.errno is not None:
            error.filename = str(path)
        raise
    return descriptor


def _target_of_link(path: Path, folder: int) -> Path | None:
    """Return where a link in an open folder leads; None if it is no link, or is missing."""
    try:
        status = os.stat(path.name or path, dir_fd=folder, follow_symlinks=False)
        if not stat.S_ISLNK(status.st_mode):
            return None
        target = Path(os.readlink(path.name, dir_fd=folder))
    except FileNotFoundError:
        return None
    if not _is_trusted(status):
        raise OSError(f"{path} is a symbolic link of another user")
    return target


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
