"""The processes that a launcher starts: start, exit status, reason of a failure, restart, end.

:class:`RestartPolicy` says which failed processes are restarted or waited for, and which failures end
the run.
"""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from cosim.live.coordination.coordinator import Coordinator
from cosim.live.monitoring.run_watcher import Watcher
from cosim.live.processes.fork_server import ENVIRONMENT, ForkedProcess, ForkServer
from noack.core.errors import ExitStatus, MachineError
from noack.core.file_access import open_append
from noack.core.system_processes import python_command
from noack.protocol.roles import PLANT, RECORDER
from noack.runtime.run_descriptor import RunDescriptor
from noack.scenario.scenario import Scenario

MODULES = {
    "recorder": "cosim.live.recording.recorder",
    "netem": "netem.__main__",
    "plant": "plant_server.__main__",
    "sensor": "sensor_node.__main__",
    "controller": "controller_node.__main__",
}
Child = ForkedProcess | subprocess.Popen[str]
RESTART_BY_HAND_S = 60.0
"""How long a run waits for the restart of a process that was started by hand."""


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

    def restart(self, role: str) -> None:
        """End a process and start another of its role.

        Raise MachineError if it cannot be started.
        """
        _end(self._children[role])
        self._children[role] = self._start(role, live=False)

    def __contains__(self, role: str) -> bool:
        """Whether the process of a role was launched, rather than started by hand."""
        return role in self._children

    def running(self) -> list[str]:
        """Roles of which the launched process has not exited."""
        return [role for role, child in self._children.items() if child.poll() is None]

    def has_reported(self, role: str) -> bool:
        """Whether a launched process has ended itself with an error message."""
        child = self._children.get(role)
        return child is not None and child.poll() in (ExitStatus.FAILED, ExitStatus.CALLER)

    def is_dead(self, role: str) -> bool:
        """Whether a launched process runs no more."""
        child = self._children.get(role)
        return child is not None and child.poll() is not None

    def failures(self, reported: Callable[[str], str | None]) -> dict[str, EndReason]:
        """How launched processes failed, by role."""
        codes = {role: child.poll() for role, child in self._children.items()}
        return {role: self._failure(role, code, reported) for role, code in codes.items() if code}

    def _start(self, role: str, *, live: bool) -> Child:
        arguments = ["--live"] if role == RECORDER and live else []
        try:
            with os.fdopen(open_append(self._run_dir / "logs" / f"{role}.log"), "a") as log:
                child = self._start_python(role, arguments, log)
        except OSError as error:
            raise MachineError(f"{role} cannot be started: {error}") from None
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
            return EndReason(ExitStatus.FAILED, f"{role} ended early: {signal_name(code - 128)}")
        known = code in (ExitStatus.FAILED, ExitStatus.CALLER)
        lines, own = self._log_lines(role), f"noack {role}: "
        # Libraries write to the log, too; and on a full disk the log may be empty.
        logged = next((line.removeprefix(own) for line in lines[::-1] if line.startswith(own)), None)
        why = logged or reported(role) or "".join(lines[-1:]) or f"exit status {code}"
        return EndReason(ExitStatus(code) if known else ExitStatus.FAILED, f"{role}: {why}")

    def _log_lines(self, role: str) -> list[str]:
        log = self._run_dir / "logs" / f"{role}.log"
        try:
            return log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except OSError:  # the run directory was removed
            return []


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


class _Failed(NamedTuple):
    """A process that has failed and may be restarted."""

    failure: EndReason
    until_s: float
    """Reading of the monotonic clock until which the run waits for the restart."""


class RestartPolicy:
    """Follows the failures of a run's processes."""

    def __init__(
        self,
        scenario: Scenario,
        coordinator: Coordinator,
        children: ChildProcesses,
        watcher: Watcher,
    ) -> None:
        self._scenario, self._coordinator = scenario, coordinator
        self._children, self._watcher = children, watcher
        self._failed: dict[str, _Failed] = {}

    def check(self) -> EndReason | None:
        """Restart what may be restarted; return why the run must end, None if it need not."""
        exited = self._children.failures(self._coordinator.await_reported_failure)
        return self._check_restarts(exited) or self._check_failures(exited)

    def unfinished(self) -> EndReason | None:
        """At the end of the run: a failure whose restart did not happen."""
        for failed in self._failed.values():
            status, why = failed.failure
            return EndReason(status, f"{why}; not restarted before the end")
        return None

    def _check_restarts(self, exited: dict[str, EndReason]) -> EndReason | None:
        """Follow the processes that the run waits for."""
        for role, ((status, why), until_s) in list(self._failed.items()):
            if self._coordinator.running_generation(role) is not None:
                del self._failed[role]
                self._watcher.restarted(role, self._t_s())
            elif role in exited:
                return EndReason(exited[role].status, f"{why}; restarted, {exited[role].reason}")
            elif time.monotonic() > until_s:
                within_s = self._restart_within_s(role)
                return EndReason(status, f"{why}; not restarted within {within_s:g} s")
        return None

    def _check_failures(self, exited: dict[str, EndReason]) -> EndReason | None:
        """Restart, or wait for, each process that has failed since the last look."""
        for role, (status, why) in self._failures(exited).items():
            within_s = self._restart_within_s(role)
            started = self._coordinator.epoch_ns is not None
            if not started or self._is_past_horizon() or role == PLANT or not within_s:
                return EndReason(status, why)
            if self._children.has_reported(role):  # a restarted process would fail alike
                return EndReason(status, why)
            self._failed[role] = _Failed(EndReason(status, why), time.monotonic() + within_s)
            launched = role in self._children
            self._coordinator.allow_restart(role, why, dead=self._children.is_dead(role))
            self._watcher.failed(why, self._t_s(), None if launched else role)
            if launched:
                try:
                    self._children.restart(role)
                except MachineError as error:
                    return EndReason(status, f"{why}; {error}")
        return None

    def _failures(self, exited: dict[str, EndReason]) -> dict[str, EndReason]:
        """Failures that are not being waited for, by role."""
        running = self._children.running()
        failures = {
            role: EndReason(ExitStatus.FAILED, why)
            for role, why in self._coordinator.failures().items()
            # The exit status of a launched process explains more than its report.
            if not (role in running and self._coordinator.is_exiting(role))
        }
        if self._is_past_horizon() and RECORDER in running:
            failures.pop(RECORDER, None)  # sorting a long record, it may not respond
        return {role: failure for role, failure in (failures | exited).items() if role not in self._failed}

    def _is_past_horizon(self) -> bool:
        return self._coordinator.now_ns() >= self._scenario.timing.horizon_ns

    def _t_s(self) -> float:
        return self._coordinator.now_ns() * 1e-9

    def _restart_within_s(self, role: str) -> float:
        given_s = self._scenario.recovery.rejoin_within_s
        if given_s is None:
            return 0.0 if role in self._children else RESTART_BY_HAND_S
        return given_s
