"""Makes an interpreter that has this folder in PYTHONPATH one without what only Linux has.

As on Windows there are no modules, functions and constants of POSIX, no /proc and /dev, no
descriptors of folders and no symbolic links, a file that is open is neither replaced nor removed,
and the core in C is without sockets. Third-party packages are imported before, as those of Linux.
"""

import ctypes
import functools
import importlib
import os
import re
import select
import shutil
import signal
import socket
import sys
import time
from pathlib import Path
from types import SimpleNamespace

THIRD_PARTY = """
    asyncio concurrent.futures.process multiprocessing.connection multiprocessing.managers
    multiprocessing.popen_spawn_posix multiprocessing.shared_memory multiprocessing.spawn
    socketserver subprocess tempfile uuid webbrowser zipfile cryptography.fernet jinja2
    matplotlib.backends.backend_pdf matplotlib.backends.backend_svg matplotlib.pyplot numpy.random
    pyarrow.parquet pydantic rich.console rich.progress scipy.linalg scipy.optimize scipy.sparse
    scipy.stats setproctitle typer zenoh
"""
MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "spwd", "syslog", "termios", "tty"}
OF_WINDOWS = {"ABRT", "FPE", "ILL", "INT", "SEGV", "TERM"}
OF_OS = re.compile(
    "(get|set)(e|res)?[ug]ids?$|[gs]et(pg|s)id$|(f|l)?chown$|(f|l)chmod$|fork|wait(3|4|id)?$|sched_|"
    "posix_|p(read|write)v?$|W[A-Z]+$|SCHED_|P_|killpg$|getloadavg$|nice$|uname$|sysconf|"
    "mk(fifo|nod)$|memfd_create$|MFD_|eventfd|pipe2$|sendfile$|splice$|fchdir$|"
    "O_(NOFOLLOW|DIRECTORY|CLOEXEC|NONBLOCK|PATH|SYNC|DSYNC|NOCTTY|TMPFILE|DIRECT|ASYNC|NOATIME)$"
)
OF_SOCKET = re.compile("AF_(UNIX|NETLINK|PACKET)|CMSG_|SCM_|MSG_|SO_(REUSEPORT|PEERCRED|RXQ_OVFL)")


class NoSuchModule:
    def find_spec(self, name: str, *_: object) -> None:
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def remove(module: object, names: re.Pattern[str]) -> None:
    for name in [name for name in dir(module) if names.match(name)]:
        delattr(module, name)


def refuse_paths_of_linux(event: str, arguments: tuple[object, ...]) -> None:
    path = arguments[0] if event in ("open", "os.listdir", "os.scandir", "os.stat") else None
    if isinstance(path, str | Path) and re.match("/(proc|sys|dev(?!/null$))/", str(path)):
        raise FileNotFoundError(2, "as on Windows: no such file", path)


def with_paths_only(name: str, places: int) -> None:
    function = getattr(os, name)

    @functools.wraps(function)
    def call(*arguments: object, **more: object) -> object:
        if any(value is not None for key, value in more.items() if key.endswith("dir_fd")):
            raise NotImplementedError(f"as on Windows: os.{name} with dir_fd")
        refuse_paths_of_linux("os.stat", arguments)
        if name == "open" and Path(str(arguments[0])).is_dir():
            raise PermissionError(13, "as on Windows: a folder cannot be opened", arguments[0])
        if any(Path(str(path)) in opened() for path in arguments[:places]):
            raise PermissionError(13, "as on Windows: the file is open", arguments[0])
        return function(*arguments, **more)

    setattr(os, name, call)


def opened() -> set[Path]:
    """The files that this process has open, as absolute and as relative paths."""
    files = set()
    for descriptor in range(3, 200):
        try:
            file = Path(readlink(f"/proc/self/fd/{descriptor}"))
        except OSError:
            continue
        files |= {file, Path(os.path.relpath(file))}
    return files


def no_link(*_: object, **__: object) -> None:
    raise OSError(22, "as on Windows: a required privilege is not held by the client")


class WithoutLiveRuns:
    """The core without the functions of the files that only Linux has."""

    def __init__(self, core: object, sources: set[Path]) -> None:
        text = "\n".join(file.read_text() for file in sources)
        self._missing = {*re.findall(r"^\w[\w ]*[ *](noack_\w+)\(", text, re.MULTILINE)}
        self._core = core

    def __getattr__(self, name: str) -> object:
        if name in self._missing:
            raise AttributeError(f"as on Windows: no function {name}")
        return getattr(self._core, name)


for module in THIRD_PARTY.split():
    importlib.import_module(module)
build = importlib.import_module("native.build")
live_sources = {*build.sources("linux")} - {*build.sources("win_amd64")}
for module in ("multiprocessing.popen_fork", "multiprocessing.resource_tracker", "subprocess"):
    sys.modules[module].__dict__.update(signal=SimpleNamespace(**vars(signal)))
readlink = os.readlink
for module in MODULES:
    sys.modules.pop(module, None)
sys.meta_path.insert(0, NoSuchModule())  # type: ignore[arg-type]
for name, places in (("open", 0), ("replace", 2), ("rename", 2), ("unlink", 1), ("remove", 1)):
    with_paths_only(name, places)
for name in ("mkdir", "rmdir", "stat", "lstat", "link", "chmod", "access"):
    with_paths_only(name, 0)
os.symlink = no_link
os.supports_dir_fd = set()
os.O_BINARY = 0
shutil._use_fd_functions = False
remove(os, OF_OS)
remove(socket, OF_SOCKET)
remove(select, re.compile("e?poll"))
remove(
    signal,
    re.compile(f"SIG(?!_)(?!({'|'.join(OF_WINDOWS)})$)|pthread_|sig(wait|pend|int|timed)|setitimer"),
)
remove(time, re.compile("clock_|CLOCK_|tzset"))
del ctypes.CDLL, ctypes.cdll
core_library = importlib.import_module("noack.core.core_library")
core_library.core = WithoutLiveRuns(core_library.core, live_sources)
sys.platform = "other"
sys.addaudithook(refuse_paths_of_linux)
