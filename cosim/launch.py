"""The launcher: starts the processes of a run, watches them, and brings everything home.

Whatever happens to a process, the launcher names it, ends the run cleanly, and leaves a run
directory with everything recorded so far.
"""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.coordinator import Coordinator
from cosim.environment import write_environment
from cosim.run_dir import SCENARIO_FILE, new_run_dir, point_to_latest, under_way
from noack.errors import ExitStatus, MachineError, NeverStartedError
from noack.io.node import HORIZON
from noack.io.process import TICKET_ON_STDIN
from noack.io.signals import Signals
from noack.io.ticket import Ticket, new_ticket, published
from noack.io.udp import LOOPBACK, free_tcp_port, require_free_tcp_port
from noack.resolve import resolve
from noack.scenario import Scenario
from noack.scenario_file import dumps as scenario_toml
from noack.topology import RECORDER, ROLES

_MODULES = {
    "recorder": "cosim.recorder",
    "netem": "netem",
    "plant": "plant_server",
    "sensor": "sensor_node",
    "controller": "controller_node",
}
_POLL_S = 0.01
_START_PATIENCE_S = 30.0
_STOP_PATIENCE_S = 15.0
_OVERTIME_S = 20.0


@dataclass(frozen=True)
class Ending:
    """How a run ended."""

    run_dir: Path
    run_id: int
    status: ExitStatus
    reason: str
    startup_s: float | None = None
    """Wall time from the launch to simulated time 0; None if nobody saw it."""


@dataclass(frozen=True)
class Watcher:
    """What the launcher tells while it works; every callback returns at once."""

    waiting: Callable[[Sequence[str]], None] = lambda roles: None
    started: Callable[[Path], None] = lambda run_dir: None
    progress: Callable[[dict[str, Any]], None] = lambda account: None


def launch(
    scenario: Scenario,
    runs: Path,
    *,
    spawn: Sequence[str] = ROLES,
    session: str | None = None,
    live: bool = False,
    watcher: Watcher | None = None,
) -> Ending:
    """Run a scenario; :func:`cosim.conclude.conclude` makes its record whole.

    Args:
        scenario: as loaded; it is resolved here.
        runs: where run directories are made.
        spawn: the roles to start; the others are started by people, who join by ``session``.
        session: name under which processes that are not spawned find the run.
        live: show the run in a viewer while it goes on.
        watcher: told of progress.

    Raises:
        CallerError, MachineError: the run could not begin.
    """
    began_ns = time.monotonic_ns()
    resolved = resolve(scenario)
    control = resolved.ports.control
    if control:
        require_free_tcp_port(control, "ports.control")
    endpoint = f"tcp/{LOOPBACK}:{control or free_tcp_port()}"
    run_dir = new_run_dir(runs, resolved.name)
    (run_dir / SCENARIO_FILE).write_text(scenario_toml(resolved), encoding="utf-8")
    write_environment(run_dir, "live")
    ticket = new_ticket(resolved, endpoint, run_dir.resolve(), launched=True)
    run = _Run(ticket, run_dir, spawn, watcher or Watcher())
    with Signals().handled() as signals, contextlib.ExitStack() as stack:
        stack.enter_context(under_way(run_dir))
        coordinator = Coordinator(ticket)
        stack.callback(coordinator.close)
        if session is not None:
            stack.enter_context(published(ticket._replace(launched=False), session))
        stack.enter_context(run.children(live=live))
        status, reason = run.watch(coordinator, signals)
    if coordinator.epoch_ns is None:
        raise NeverStartedError(f"{reason} (logs in {run_dir / 'logs'})", status)
    startup_s = (coordinator.epoch_ns - began_ns) * 1e-9
    return Ending(run_dir, ticket.run_id, status, reason, startup_s)


class _Run:
    def __init__(
        self, ticket: Ticket, run_dir: Path, spawn: Sequence[str], watcher: Watcher
    ) -> None:
        self._ticket = ticket
        self._run_dir = run_dir
        self._spawn = spawn
        self._watcher = watcher
        self._children: dict[str, subprocess.Popen[str]] = {}

    @contextlib.contextmanager
    def children(self, *, live: bool) -> Iterator[None]:
        """Start the processes; leave none behind."""
        try:
            for role in _MODULES:
                if role in self._spawn:
                    self._children[role] = self._start(role, live=live)
            yield
        finally:
            for child in self._children.values():
                if child.poll() is None:
                    child.kill()
                child.wait()
                if child.stdin is not None:
                    with contextlib.suppress(OSError):
                        child.stdin.close()

    def watch(self, coordinator: Coordinator, signals: Signals) -> tuple[ExitStatus, str]:
        """Follow the run to its end; return its exit status and why it ended."""
        scenario = self._ticket.scenario
        verdict: tuple[ExitStatus, str] | None = None
        told: tuple[str, ...] = ()
        by_hand = any(role not in self._spawn for role in ROLES)
        patience_s = float("inf") if by_hand else time.monotonic() + _START_PATIENCE_S
        started = False
        while not self._over(coordinator, stopping=verdict is not None):
            coordinator.poll()
            now_s = time.monotonic()
            if coordinator.epoch_ns is None:
                missing = tuple(r for r in coordinator.missing() if r not in self._spawn)
                if missing != told:
                    told = missing
                    self._tell(self._watcher.waiting, missing)
            elif not started:
                started = True
                point_to_latest(self._run_dir)
                self._tell(self._watcher.started, self._run_dir)
                patience_s = now_s + scenario.horizon_s / scenario.speed + _OVERTIME_S
            if (account := coordinator.progress()) is not None:
                self._tell(self._watcher.progress, account)
            if verdict is None:
                verdict = self._trouble(coordinator, signals)
                if verdict is None and now_s > patience_s:
                    verdict = (ExitStatus.FAILED, _overdue(coordinator))
                if verdict is not None:
                    coordinator.stop(verdict[1])
                    patience_s = now_s + _STOP_PATIENCE_S
            elif now_s > patience_s:
                break
            time.sleep(_POLL_S)
        return verdict or self._trouble(coordinator, signals) or (ExitStatus.OK, HORIZON)

    def _tell(self, callback: Callable[..., None], *arguments: object) -> None:
        try:
            callback(*arguments)
        except OSError:  # whoever watched has gone; the run goes on
            self._watcher = Watcher()

    def _start(self, role: str, *, live: bool) -> subprocess.Popen[str]:
        # -P: a module of the folder in which the person stands must not shadow one of ours.
        command = [sys.executable, "-P", "-m", _MODULES[role]]
        if role == RECORDER and live:
            command.append("--live")
        environment = os.environ | {
            TICKET_ON_STDIN: "1",
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONUTF8": "1",
        }
        try:
            with (self._run_dir / "logs" / f"{role}.log").open("w") as log:
                child = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    encoding="utf-8",
                    start_new_session=True,  # a Ctrl-C is the launcher's to handle
                    env=environment,
                )
        except OSError as error:
            raise MachineError(f"{role} cannot be started: {error}") from None
        assert child.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            child.stdin.write(self._ticket.dumps() + "\n")
            child.stdin.flush()
        return child

    def _over(self, coordinator: Coordinator, *, stopping: bool) -> bool:
        if any(child.poll() is None for child in self._children.values()):
            # A frozen process never exits; it is not waited for.
            return stopping and all(
                child.poll() is not None or role in set(coordinator.vanished())
                for role, child in self._children.items()
            )
        others = [role for role in ROLES if role not in self._spawn]
        gone = set(coordinator.vanished()) | set(coordinator.left)
        return stopping or all(role in gone for role in others)

    def _trouble(self, coordinator: Coordinator, signals: Signals) -> tuple[ExitStatus, str] | None:
        if signals.received is not None:
            return signals.status, f"stopped by {_name(signals.received)}"
        for role, child in self._children.items():
            code = child.poll()
            if code is not None and code != 0:
                return self._died(role, code)
        for role in coordinator.vanished():
            return ExitStatus.FAILED, f"{role} stopped answering"
        for role, why in coordinator.left.items():
            if why != HORIZON and role != RECORDER:
                return ExitStatus.FAILED, f"{role} ended early: {why}"
        return None

    def _died(self, role: str, code: int) -> tuple[ExitStatus, str]:
        if code < 0:
            return ExitStatus.FAILED, f"{role} died: killed by {_name(-code)}"
        if code in (ExitStatus.INTERRUPTED, ExitStatus.TERMINATED):
            return ExitStatus.FAILED, f"{role} ended early: {_name(code - 128)}"
        log = self._run_dir / "logs" / f"{role}.log"
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        said = lines[-1].removeprefix(f"noack {role}: ") if lines else f"exit status {code}"
        known = code in (ExitStatus.FAILED, ExitStatus.CALLER)
        return ExitStatus(code) if known else ExitStatus.FAILED, f"{role}: {said}"


def _overdue(coordinator: Coordinator) -> str:
    if coordinator.epoch_ns is None:
        return f"{', '.join(coordinator.missing())} did not come to the start"
    return "the run did not end at its horizon"


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
