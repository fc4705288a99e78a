"""The processes that a launcher starts: start, exit status, reason of a failure, end."""

import contextlib
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from cosim.live.processes.fork_server import ENVIRONMENT, ForkedProcess, ForkServer
from noack.core.errors import ExitStatus, MachineError, why
from noack.core.file_access import open_append
from noack.core.system_processes import python_command
from noack.protocol.roles import RECORDER
from noack.runtime.run_descriptor import RunDescriptor

MODULES = {
    "recorder": "cosim.live.recording.recorder",
    "netem": "netem.__main__",
    "plant": "plant_server.__main__",
    "sensor": "sensor_node.__main__",
    "controller": "controller_node.__main__",
}
Child = ForkedProcess | subprocess.Popen[str]


class EndReason(NamedTuple):
    """How a process failed, or how a run ended."""

    status: ExitStatus
    reason: str


class ChildProcesses:
    """The launched processes of a run, by role.

    Each receives the run descriptor on its standard input, which stays open until the
    launcher ends.
    """

    def __init__(
        self,
        descriptor: RunDescriptor,
        run_dir: Path,
        roles: Sequence[str],
        server: ForkServer | None = None,
    ) -> None:
        self._server = server
        self._descriptor = descriptor
        self._run_dir = run_dir
        self._roles = [role for role in MODULES if role in roles]
        self._children: dict[str, Child] = {}

    @contextmanager
    def started(self, *, live: bool) -> Iterator[None]:
        """Start the processes; end all of them with the context.

        Raise MachineError if a process cannot be started.
        """
        try:
            for role in self._roles:
                self._children[role] = self._start(role, live=live)
            yield
        finally:
            for child in self._children.values():
                _end(child)

    def __contains__(self, role: str) -> bool:
        """Whether the process of a role was launched, rather than started by hand."""
        return role in self._children

    def running(self) -> list[str]:
        """Roles of which the launched process has not exited."""
        return [role for role, child in self._children.items() if child.poll() is None]

    def failures(self, reported: Callable[[str], str | None]) -> dict[str, EndReason]:
        """How launched processes failed, by role."""
        codes = {role: child.poll() for role, child in self._children.items()}
        return {role: self._failure(role, code, reported) for role, code in codes.items() if code}

    def stopped(self) -> set[str]:
        """Roles of which the launched process is stopped, by a signal or by a debugger."""
        return {role for role, child in self._children.items() if _state(child.pid) in ("T", "t")}

    def _start(self, role: str, *, live: bool) -> Child:
        arguments = ["--live"] if role == RECORDER and live else []
        try:
            with os.fdopen(open_append(self._run_dir / "logs" / f"{role}.log"), "a") as log:
                child = self._start_python(role, arguments, log)
        except OSError as error:
            raise MachineError(f"{role} cannot be started: {why(error)}") from None
        assert child.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            child.stdin.write(self._descriptor.model_dump_json() + "\n")
            child.stdin.flush()
        return child

    def _start_python(self, role: str, arguments: list[str], log: IO[str]) -> Child:
        if self._server is not None:
            return self._server.start(MODULES[role], arguments, log)
        return subprocess.Popen(
            python_command("-m", MODULES[role], *arguments),
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            encoding="utf-8",
            start_new_session=True,  # the launcher handles Ctrl-C
            env=os.environ | ENVIRONMENT,
        )

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


def _end(child: Child) -> None:
    """Kill a process if it still runs, and wait for its end."""
    if child.poll() is None:
        child.kill()
    child.wait()
    if child.stdin is not None:
        with contextlib.suppress(OSError):
            child.stdin.close()


def signal_name(number: int) -> str:
    """Name of a signal."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
