"""The processes that a launcher starts: start, exit status, reason of a failure, end.

They are forked from a process that has imported what they need (``process_imports.py``): of a command, as
long as it has one thread, from the command itself; of a program that uses the library, which may
have threads, from Python's fork server, which remains for later runs.

With Python's fork server ``noack run`` takes 1.6 times as long to its first control step (on two busy
cores 6.3 times as long as the import of numpy, scipy and zenoh, instead of 4.0 times): the server
repeats the imports of the command.
"""

import contextlib
import ctypes
import gc
import multiprocessing
import multiprocessing.util
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

from cosim.live.processes.process_pool import ENDINGS, environment, process_starts
from netem.core.errors import ExitStatus, MachineError, why
from netem.core.file_access import open_append
from netem.core.system_processes import require_limits
from noack.protocol.roles import RECORDER
from noack.runtime.run_descriptor import DESCRIPTOR_ON_STDIN, RunDescriptor

MODULES = {
    "recorder": "cosim.live.recording.recorder",
    "netem": "noack.network_process.__main__",
    "plant": "plant_server.__main__",
    "sensor": "sensor_node.__main__",
    "controller": "controller_node.__main__",
}
_PRELOADED = "cosim.live.processes.process_imports"
_MALLOPT = {-8: 2, -3: 131_072, -1: 131_072}
"""M_ARENA_MAX, M_MMAP_THRESHOLD, M_TRIM_THRESHOLD of glibc: a process returns memory to the system
after a busy moment. Otherwise glibc raises these thresholds with each large block, and keeps an arena
for each thread."""
_PYTHONS_GC_THRESHOLDS = (700, 10, 10)


class EndReason(NamedTuple):
    """How a process failed, or how a run ended."""

    status: ExitStatus
    reason: str


class ChildProcesses:
    """The launched processes of a run, by role.

    Each receives the run descriptor on its standard input, which stays open until the
    launcher ends.

    Args:
        run_dir: the run directory, with the folder of their logs.
        roles: of the processes.
        live: show the run in a viewer.
        fork: fork this process, if that is possible.
    """

    def __init__(self, run_dir: Path, roles: Sequence[str], *, live: bool = False, fork: bool) -> None:
        self._run_dir = run_dir
        self._live = live
        self._forks = fork and _can_fork()
        get_context = multiprocessing.get_context
        self._context = get_context("fork") if self._forks else get_context("forkserver")
        self._roles = [role for role in MODULES if role in roles]
        self._children: dict[str, BaseProcess] = {}
        self._inputs: dict[str, Connection] = {}
        """The other ends of their standard inputs."""

    def start(self) -> None:
        """Start the processes; raise MachineError if one cannot be started."""
        require_limits()
        _open_standard_streams()
        if self._forks:
            import_module(_PRELOADED)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # an inherited "ignore" hides exit statuses
        else:
            # Python 3.11.0 would listen on an abstract socket, to which each user can connect.
            multiprocessing.util.abstract_sockets_supported = False  # type: ignore[misc]
            self._context.set_forkserver_preload([_PRELOADED])
        for role in self._roles:
            try:
                self._start(role)
            except OSError as error:
                raise MachineError(f"{role} cannot be started: {why(error)}") from None

    def _start(self, role: str) -> None:
        log = self._run_dir / "logs" / f"{role}.log"
        os.close(open_append(log))
        its_stdin, own_end = self._context.Pipe(duplex=False)
        arguments = ["--live"] if role == RECORDER and self._live else []
        # What a fork inherits, or else has to be given.
        others = [*self._inputs.values(), own_end] if self._forks else []
        variables = {} if self._forks else dict(os.environ)
        call = (MODULES[role], arguments, its_stdin, log, others, variables)
        # The fork server imports nothing from the current folder.
        with environment({"PYTHONSAFEPATH": "1"}), process_starts():
            child = self._context.Process(target=_be_process, args=call)
            child.start()
        its_stdin.close()
        self._children[role], self._inputs[role] = child, own_end

    def send(self, descriptor: RunDescriptor) -> None:
        """Let the processes join the run."""
        text = descriptor.model_dump_json() + "\n"
        for stdin in self._inputs.values():
            with contextlib.suppress(BrokenPipeError), open(stdin.fileno(), "w", closefd=False) as stream:
                stream.write(text)

    def end(self) -> None:
        """Kill the processes that still run, and wait for their end."""
        for child in self._children.values():
            child.kill()
            child.join()
        for stdin in self._inputs.values():
            stdin.close()

    def __contains__(self, role: str) -> bool:
        """Whether the process of a role was launched, rather than started by hand."""
        return role in self._children

    def running(self) -> list[str]:
        """Roles of which the launched process has not exited."""
        return [role for role, child in self._children.items() if child.exitcode is None]

    def failures(self, reported: Callable[[str], str | None]) -> dict[str, EndReason]:
        """How launched processes failed, by role."""
        codes = {role: child.exitcode for role, child in self._children.items()}
        return {role: self._failure(role, code, reported) for role, code in codes.items() if code}

    def stopped(self) -> set[str]:
        """Roles of which the launched process is stopped, by a signal or by a debugger."""
        return {
            role for role, child in self._children.items() if child.pid and _state(child.pid) in ("T", "t")
        }

    def _failure(self, role: str, code: int, reported: Callable[[str], str | None]) -> EndReason:
        if code < 0:
            return EndReason(ExitStatus.FAILED, f"{role} died: killed by {signal_name(-code)}")
        if code in (ExitStatus.INTERRUPTED, ExitStatus.TERMINATED):
            # SIGHUP has the exit status of SIGTERM.
            by = reported(role) or signal_name(code - 128)
            return EndReason(ExitStatus.FAILED, f"{role} ended early: {by}")
        known = code in (ExitStatus.FAILED, ExitStatus.CALLER)
        lines, own = self._log_lines(role), f"noack {role}: "
        # Libraries write to the log, too; and on a full disk the log may be empty.
        logged = next((line.removeprefix(own) for line in lines[::-1] if line.startswith(own)), None)
        why = logged or reported(role) or "".join(lines[-1:])
        text = f"{role}: {why}" if why else f"{role} ended with exit status {code}"
        return EndReason(ExitStatus(code) if known else ExitStatus.FAILED, text)

    def _log_lines(self, role: str) -> list[str]:
        log = self._run_dir / "logs" / f"{role}.log"
        try:
            return log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except OSError:  # the run directory was removed
            return []


def _state(pid: int) -> str:
    """Return the state of a process, a letter as in ``ps``; empty if the system does not tell it."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return status.rpartition(")")[2].split()[0]


def _can_fork() -> bool:
    """Whether a fork of this process works as every process must: with one thread, and in UTF-8."""
    threads = len([*Path("/proc/self/task").iterdir()])
    return threads == 1 and sys.getfilesystemencoding() == "utf-8"


def _open_standard_streams() -> None:
    """Open those that are closed: a process would otherwise take another file for them."""
    while (null := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(null, True)
    os.close(null)


def _be_process(
    module: str,
    arguments: Sequence[str],
    stdin: Connection,
    log: Path,
    others: Sequence[Connection],
    variables: Mapping[str, str],
) -> None:
    """Be a process of a run; exit with the status of ``main`` of its module.

    Args:
        module: name of the module.
        arguments: arguments of ``main``.
        stdin: becomes the standard input.
        log: becomes standard output and standard error.
        others: ends of pipes that are inherited, and belong to the launcher only.
        variables: the launcher's environment, unless it is inherited.
    """
    os.setsid()  # the launcher handles Ctrl-C
    for other in others:
        other.close()
    output = open_append(log)
    for standard, given in ((0, stdin.fileno()), (1, output), (2, output)):
        os.dup2(given, standard)
    stdin.close()
    os.close(output)
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115 - until the end of the process
    sys.stdout, sys.stderr = (
        open(number, "w", 1, encoding="utf-8", errors=errors, closefd=False)  # noqa: SIM115
        for number, errors in ((1, "strict"), (2, "backslashreplace"))
    )
    for name in os.environ.keys() - variables.keys() if variables else ():  # of an earlier run
        del os.environ[name]
    # Without MIMALLOC_PURGE_DELAY pyarrow keeps memory that it has freed.
    os.environ.update({**variables, DESCRIPTOR_ON_STDIN: "1", "MIMALLOC_PURGE_DELAY": "0"})
    with contextlib.suppress(AttributeError):  # another C library
        for parameter, value in _MALLOPT.items():
            ctypes.CDLL(None).mallopt(parameter, value)
    gc.set_threshold(*_PYTHONS_GC_THRESHOLDS)
    for number in ENDINGS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
            if number is signal.SIGINT:
                signal.signal(number, signal.default_int_handler)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDINGS)
    sys.exit(import_module(module).main(arguments))


def signal_name(number: int) -> str:
    """Name of a signal."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
