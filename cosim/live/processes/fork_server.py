"""The fork server: a process that imports what a run needs once, and forks the run's processes.

Otherwise each process would spend a third of a second on the same imports when it starts. The server
has one thread, so that it can be forked, and ends with its launcher. Linux only.

A command that begins a run imports what it has in common with the processes, and then forks the
server of itself: these imports, most of all, are done once. The server imports the rest while the
command reads its options. For a program that uses the library the server is a program of its own,
because the program may have threads.
"""

import ctypes
import gc
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import IO

from pydantic import BaseModel

from noack.core.errors import MachineError, why
from noack.core.system_processes import QUICK_IMPORTS, python_command, require_limits
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.runtime.command_line import DESCRIPTOR_ON_STDIN
from noack.runtime.control_messages import ControlMessage
from noack.runtime.run_descriptor import RunDescriptor
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_checks import prepare_changes

_COMMON = (
    "noack.runtime.control_plane",
    "noack.scenario.scenario_file",
    "noack.scenario.resolution",
    "noack.core.random_streams",
)
"""What the processes and the launcher import, beside the imports of this module."""
_IMPORTS = (
    *_COMMON,
    "plant_server.__main__",
    "sensor_node.__main__",
    "controller_node.__main__",
    "netem.__main__",
    "cosim.live.recording.recorder",
    "numpy.random",
    "zenoh",
)
ENVIRONMENT = {
    DESCRIPTOR_ON_STDIN: "1",
    **QUICK_IMPORTS,
    "PYTHONUTF8": "1",
    # Return memory to the system after a busy moment. Unless they are set, glibc raises these
    # thresholds with each large block, and keeps an arena for each thread.
    "MIMALLOC_PURGE_DELAY": "0",
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    "MALLOC_ARENA_MAX": "2",
    "MALLOC_MMAP_THRESHOLD_": "131072",
    "MALLOC_TRIM_THRESHOLD_": "131072",
}
"""Environment variables of the processes of a run, beside the launcher's."""
_MALLOPT = {-8: 2, -3: 131_072, -1: 131_072}
"""The last three of them, as glibc's mallopt takes them: it reads the environment only once."""
_PYTHONS_GC_THRESHOLDS = (700, 10, 10)
_MOST_BYTES = 65_536
"""Most bytes of a request or an answer."""
_START_TIMEOUT_S = 120.0
_PR_SET_CHILD_SUBREAPER = 36


class ForkedProcess:
    """A process that was forked, and is a child of the launcher."""

    def __init__(self, pid: int, stdin: IO[str] | None = None) -> None:
        self.pid = pid
        self.stdin = stdin
        self._status: int | None = None

    def poll(self) -> int | None:
        """Return the exit status (−n: killed by signal n), or None while the process runs."""
        return self._wait(os.WNOHANG)

    def wait(self) -> int | None:
        """Wait for the end of the process; return its exit status."""
        return self._wait(0)

    def kill(self) -> None:
        """Kill the process."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)

    def _wait(self, options: int) -> int | None:
        if self._status is None:
            try:
                pid, status = os.waitpid(self.pid, options)
            except ChildProcessError:  # SIGCHLD is ignored; subprocess returns 0, too
                pid, status = self.pid, 0
            if pid:
                self._status = os.waitstatus_to_exitcode(status)
        return self._status


class ForkServer:
    """The launcher's end of a fork server.

    The server forks twice. Linux gives a process whose parent has ended to its nearest ancestor
    that adopts orphans: while the server lives, this process does.

    Args:
        of_itself: fork the server of this process, if that is possible; of a command, before it
            has begun its work.

    Raises:
        MachineError: a limit of the system is too low for a run.
        OSError: it cannot be started.
    """

    def __init__(self, *, of_itself: bool = False) -> None:
        require_limits()
        self._socket, server_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(_START_TIMEOUT_S)
        with server_end, ExitStack() as on_error:
            on_error.callback(self._socket.close)
            forked = self._fork_program(server_end) if of_itself else None
            self._process = forked or subprocess.Popen(
                python_command("-m", "cosim.live.processes.fork_server", server_end.fileno()),
                pass_fds=[server_end.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # the launcher handles Ctrl-C
                env=os.environ | ENVIRONMENT,
            )
            on_error.pop_all()
        _adopt_orphans(True)

    def _fork_program(self, server_end: socket.socket) -> ForkedProcess | None:
        """Fork the server; None if only a program of its own would work as every process must.

        That is one thread, open standard streams, and UTF-8 for files and streams.
        """
        _import(_COMMON)
        Scenario.model_rebuild()  # the launcher needs its validators, too
        threads = len([*Path("/proc/self/task").iterdir()])
        is_closed = None in (sys.stdin, sys.stdout, sys.stderr)
        if threads > 1 or is_closed or sys.getfilesystemencoding() != "utf-8":
            return None
        if (pid := os.fork()) > 0:
            return ForkedProcess(pid)
        self._socket.close()
        os.setsid()  # the launcher handles Ctrl-C
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, signal.SIG_DFL)
                if number is signal.SIGINT:
                    signal.signal(number, signal.default_int_handler)
        os.environ.update(ENVIRONMENT)
        with suppress(AttributeError):  # another C library
            for parameter, value in _MALLOPT.items():
                ctypes.CDLL(None).mallopt(parameter, value)
        gc.set_threshold(*_PYTHONS_GC_THRESHOLDS)
        _run(server_end)
        sys.exit()

    def close(self) -> None:
        """End the server; its processes go on."""
        self._socket.close()
        self._process.kill()  # it has nothing to lose, and may still import
        self._process.wait()
        _adopt_orphans(False)

    def start(self, module: str, arguments: Sequence[str], log: IO[str]) -> ForkedProcess:
        """Start a process that calls ``main(arguments)`` of a module.

        Args:
            module: name of the module.
            arguments: arguments of ``main``.
            log: its standard output and standard error.

        Raises:
            OSError: it cannot be started.
        """
        its_stdin, own_stdin = os.pipe()
        try:
            request = json.dumps([module, arguments]).encode()
            # The server has ended; the empty answer below says so.
            with suppress(BrokenPipeError, ConnectionResetError):
                socket.send_fds(self._socket, [request], [its_stdin, log.fileno()])
            pid = int(self._socket.recv(_MOST_BYTES) or 0)
            if pid < 0:
                raise OSError(-pid, os.strerror(-pid))
            if pid == 0:
                raise OSError("the fork server ended")
        except BaseException:
            os.close(own_stdin)
            raise
        finally:
            os.close(its_stdin)
        return ForkedProcess(pid, os.fdopen(own_stdin, "w", encoding="utf-8"))


@contextmanager
def fork_server(server: ForkServer | None = None) -> Iterator[ForkServer | None]:
    """Have a fork server while the context lasts, this or a new one; None without Linux.

    Raise MachineError if it cannot be started.
    """
    if sys.platform != "linux":
        yield None
        return
    try:
        server = server or ForkServer()
    except OSError as error:
        raise MachineError(f"the fork server cannot be started: {why(error)}") from None
    with closing(server):
        yield server


def _adopt_orphans(adopt: bool) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopt), 0, 0, 0)


def _serve(connection: socket.socket) -> tuple[str, list[str]] | None:
    """Fork a process for each request; return the request in the process, and None at the end."""
    while True:
        try:
            data, (stdin, log), _, _ = socket.recv_fds(connection, _MOST_BYTES, 2)
        except (OSError, ValueError):  # the launcher has ended
            return None
        try:
            pid = _fork_twice()
        except OSError as error:
            pid = -(error.errno or 1)
        if pid == 0:
            connection.close()
            os.setsid()  # the launcher handles Ctrl-C
            for standard, given in ((0, stdin), (1, log), (2, log)):
                os.dup2(given, standard)
        os.close(stdin)
        os.close(log)
        if pid == 0:
            module, arguments = json.loads(data)
            return module, arguments
        connection.send(str(pid).encode())


def _fork_twice() -> int:
    """Return the new process's pid after its parent has ended; in the process return 0."""
    receiving, sending = os.pipe()
    between = os.fork()
    if between == 0:
        try:
            pid = os.fork()
        except OSError as error:
            pid = -(error.errno or 1)
        if pid == 0:
            os.close(receiving)
            os.close(sending)
            return 0
        os.write(sending, str(pid).encode())
        os._exit(0)
    os.close(sending)
    with os.fdopen(receiving, "rb") as answer:
        pid = int(answer.read() or 0)
    os.waitpid(between, 0)
    return pid


def _build_validators() -> None:
    """Build what would otherwise be built in each process."""
    models: list[type[BaseModel]] = [
        Scenario,
        RunDescriptor,
        LinkSettings,
        LossOf,
        *ControlMessage.__subclasses__(),
    ]
    for model in models:
        model.model_rebuild()
    prepare_changes()


def main() -> None:
    """Run the server."""
    _run(socket.socket(fileno=int(sys.argv[1])))


def _import(modules: Sequence[str]) -> None:
    for module in modules:
        import_module(module)


def _run(connection: socket.socket) -> None:
    """Import, and fork processes; in each of them exit with the status of its ``main``."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # a parent's "ignore" is inherited
    gc.disable()
    _import(_IMPORTS)
    _build_validators()
    # What was collected now would leave holes, which each process would fill on pages of its own.
    gc.freeze()
    gc.enable()
    request = _serve(connection)
    if request is not None:
        module, arguments = request
        sys.exit(import_module(module).main(arguments))


if __name__ == "__main__":
    main()
