"""The cache of compiled code, in the user's cache folder.

numba unpickles cached files. So another user who can write to the cache could run code as this
user. For this reason a folder that another user can change is neither read nor written.
"""

import hashlib
import importlib
import os
import shutil
import signal
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from noack.core.file_access import locked

_ROOM_BYTES = 16 * 1024 * 1024
"""Room on disk that compiled code needs."""
_KEPT_S = 30 * 24 * 3600
"""Age of the code of other versions at which it is removed."""
Function = Callable[..., object]
CALLED_BY_CODE: Mapping[str, bool] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""numba's options of a function that only compiled code calls. It is compiled without the entries
for Python and C, each of which would hold its code once more."""


def cache_folder(name: str, sources: Iterable[Path]) -> Path | None:
    """Return the cache folder for code of these sources; None if there is no safe, writable one.

    The folder's name depends on the content of all sources, because numba checks only the file of
    the outermost function. Only the user and root can change the folder and the folders above it.
    """
    from importlib.metadata import version  # slow to import

    digest = hashlib.blake2b(version("numba").encode(), digest_size=8)
    for source in sources:
        digest.update(source.read_bytes())
    try:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = (root / "noack" / f"{name}-{digest.hexdigest()}").resolve()
        _make_own(folder)
        for file in folder.rglob("*"):
            _examine(file)
        _forget_old(folder, name)
        with tempfile.TemporaryFile(dir=folder) as probe:
            if next(folder.rglob("*.nbi"), None) is None:
                os.posix_fallocate(probe.fileno(), 0, _ROOM_BYTES)
    except (OSError, RuntimeError):  # not writable, another user's folder, disk full, or no home
        return None
    return folder


def _make_own(folder: Path) -> None:
    """Create a folder, and missing folders above it, with access for the user only.

    Raise PermissionError if another user may change the folder or a folder above it.
    """
    for level in (*reversed(folder.parents), folder):
        with suppress(FileExistsError):
            level.mkdir(mode=0o700)
        status = level.stat(follow_symlinks=False)
        if level == folder.parent:
            _require_own(level, status)
            level.chmod(0o700)  # independent of the umask
        elif status.st_uid not in (0, os.getuid()) or _others_may_write(status):
            raise PermissionError(f"{level} can be changed by another user")
    _require_own(folder, status)
    folder.chmod(0o700)


def _examine(file: Path) -> None:
    """Require that a file belongs to the user; remove it if it is empty."""
    with suppress(FileNotFoundError):  # another process may have renamed it
        status = file.lstat()
        _require_own(file, status)
        if file.suffix in (".nbi", ".nbc") and status.st_size == 0:
            file.unlink()  # from a power failure; numba fails on an empty file


def _others_may_write(status: os.stat_result) -> bool:
    """Return whether others may replace the user's files; in a sticky folder they may not."""
    return bool(status.st_mode & 0o022) and not status.st_mode & stat.S_ISVTX


def _require_own(path: Path, status: os.stat_result) -> None:
    if status.st_uid != os.getuid():
        raise PermissionError(f"{path} belongs to another user")


def is_kept(folder: Path | None, function: Function) -> bool:
    """Return whether a folder has the compiled code of a function for this computer."""
    return folder is not None and any(folder.rglob(f"*.{function.__name__}-*.nbi"))


def while_compiling(title: str, is_cached: bool) -> str:
    """Return the line that explains the wait for a compilation."""
    once = "once" if is_cached else "as the user's cache (XDG_CACHE_HOME) cannot be used"
    return f"compiling {title} for this machine, {once} ..."


def _forget_old(folder: Path, name: str) -> None:
    os.utime(folder)
    for cached in folder.parent.glob(f"{name}-*"):
        if cached.stat().st_mtime < time.time() - _KEPT_S:
            shutil.rmtree(cached, ignore_errors=True)


def compiler(folder: Path | None, **options: str | bool) -> Callable[[Function], Function]:
    """Return a compiler of functions that caches in a folder, if there is one.

    Without a folder numba must not cache at all: it could load code of other sources elsewhere.
    """
    numba: Any = importlib.import_module("numba")  # an extra of noack, and slow to import
    if folder is None:
        compiling: Callable[[Function], Function] = numba.njit(**options)
        return compiling

    def compile_and_keep(function: Function) -> Any:
        numba.config.CACHE_DIR = str(folder)
        dispatcher = numba.njit(function, cache=True, **options)
        dispatcher.compile = _one_at_a_time(dispatcher.compile, folder / ".lock")
        return dispatcher

    return compile_and_keep


def _one_at_a_time(compiling: Function, lock: Path) -> Function:
    """Allow one process to compile at a time; the others then read the cache. Delay Ctrl-C."""

    def compile_alone(signature: object) -> object:
        with ExitStack() as stack:
            with suppress(OSError):  # without file locks every process compiles
                stack.enter_context(locked(lock, wait=True))
            stack.enter_context(_signals_delayed())
            return compiling(signature)

    return compile_alone


@contextmanager
def _signals_delayed() -> Iterator[None]:
    """Delay handled signals: an exception in a Python callback of LLVM would crash the process."""
    received: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    handlers = {number: signal.getsignal(number) for number in numbers}
    delayed = {number: handler for number, handler in handlers.items() if callable(handler)}
    if threading.current_thread() is not threading.main_thread():
        delayed = {}
    for number in delayed:
        signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in delayed.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])
