"""The fork server: a process that imports what a run needs once, and forks the run's processes.

Otherwise each process would spend half a second on the same imports, when it starts and when it is
restarted. The server imports them while the launcher prepares the run. It has one thread, so that
it can be forked, and ends with its launcher. Linux only.
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
from typing import IO

from noack.core.errors import MachineError
from noack.core.process_limits import require_limits
from noack.core.python_process import python_command
from noack.runtime.command_line import TICKET_ON_STDIN

_IMPORTS = (
    "plant_server.__main__", "sensor_node.__main__", "controller_node.__main__", "netem.__main__",
    "cosim.live.recorder", "numpy.random", "zenoh",
)  # fmt: skip
QUICK_IMPORTS = {
    "OPENBLAS_NUM_THREADS": "1",  # numpy starts no threads
    "PYDANTIC_DISABLE_PLUGINS": "__all__",  # no search among all installed packages
}
ENVIRONMENT = {
    TICKET_ON_STDIN: "1",
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
_MOST_BYTES = 65_536
_START_TIMEOUT_S = 120.0
_PR_SET_CHILD_SUBREAPER = 36


class ForkedProcess:
    """A process from the fork server, and a child of the launcher; see :class:`ForkServer`."""

    def __init__(self, pid: int, stdin: IO[str]) -> None:
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
                os.kill(self.pid, 9)

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

    Raises:
        MachineError: a limit of the system is too low for a run.
        OSError: it cannot be started.
    """

    def __init__(self) -> None:
        require_limits()
        self._socket, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(_START_TIMEOUT_S)
        with its, ExitStack() as on_error:
            on_error.callback(self._socket.close)
            self._process = subprocess.Popen(
                python_command("-m", "cosim.live.fork_server", its.fileno()),
                pass_fds=[its.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # the launcher handles Ctrl-C
                env=os.environ | ENVIRONMENT,
            )
            on_error.pop_all()
        _adopt_orphans(True)

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
            with suppress(BrokenPipeError, ConnectionResetError):  # likewise no answer
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

    Raises:
        MachineError: it cannot be started.
    """
    if sys.platform != "linux":
        yield None
        return
    try:
        server = server or ForkServer()
    except OSError as error:
        raise MachineError(f"the fork server cannot be started: {error}") from None
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
    from noack.config.scenario_checks import prepare_changes
    from noack.impairments.kinds.loss import LossOf
    from noack.impairments.link_settings import LinkSettings
    from noack.runtime.join_ticket import Ticket

    for section in (Ticket, LinkSettings, LossOf):
        section.model_rebuild()
    prepare_changes()


def main() -> None:
    """Run the server."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # a parent's "ignore" is inherited
    connection = socket.socket(fileno=int(sys.argv[1]))
    gc.disable()
    for module in _IMPORTS:
        import_module(module)
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
