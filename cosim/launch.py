"""The launcher: starts the processes of a run, watches them, and brings everything home.

Whatever happens to a process, the launcher names it, ends the run cleanly, and leaves a run
directory with everything recorded so far.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from cosim.coordinator import Coordinator
from cosim.environment import environment
from cosim.record import (
    ENVIRONMENT_FILE,
    RECORD,
    SCENARIO_FILE,
    SPOOL,
    SUMMARY_FILE,
    finish_record,
    load_record,
)
from cosim.summary import Summary, dumps, summarise
from noack.errors import CallerError, ExitStatus, MachineError, NeverStartedError
from noack.io.node import HORIZON, TICKET_ON_STDIN, Signals
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
_STOP_PATIENCE_S = 15.0
_OVERTIME_S = 20.0
LATEST = "latest"


@dataclass(frozen=True)
class Outcome:
    """What became of a run."""

    run_dir: Path
    status: ExitStatus
    reason: str
    summary: Summary


@dataclass(frozen=True)
class Watcher:
    """What the launcher tells while it works; every callback returns at once."""

    waiting: Callable[[Sequence[str]], None] = lambda roles: None
    started: Callable[[Path], None] = lambda run_dir: None
    progress: Callable[[dict[str, Any]], None] = lambda account: None


def new_run_dir(runs: Path, name: str) -> Path:
    """Create a fresh run directory below ``runs``.

    Raises:
        MachineError: the directory cannot be created.
    """
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    try:
        runs.mkdir(parents=True, exist_ok=True)
        for attempt in range(1000):
            run_dir = runs / (f"{stamp}-{name}" + (f"-{attempt}" if attempt else ""))
            with contextlib.suppress(FileExistsError):
                run_dir.mkdir()
                (run_dir / "logs").mkdir()
                return run_dir
    except OSError as error:
        raise MachineError(f"{runs}: no run directory can be created: {error}") from None
    raise MachineError(f"{runs}: too many runs named {stamp}-{name}")


def _point_to_latest(run_dir: Path) -> None:
    scratch = run_dir.parent / f".{LATEST}.{os.getpid()}"
    with contextlib.suppress(OSError):  # a convenience, not worth a run
        scratch.unlink(missing_ok=True)
        scratch.symlink_to(run_dir.name)
        scratch.replace(run_dir.parent / LATEST)


def launch(
    scenario: Scenario,
    runs: Path,
    *,
    spawn: Sequence[str] = ROLES,
    session: str | None = None,
    live: bool = False,
    watcher: Watcher | None = None,
) -> Outcome:
    """Run a scenario.

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
    resolved = resolve(scenario)
    control = resolved.ports.control
    if control:
        require_free_tcp_port(control, "ports.control")
    endpoint = f"tcp/{LOOPBACK}:{control or free_tcp_port()}"
    run_dir = new_run_dir(runs, resolved.name)
    (run_dir / SCENARIO_FILE).write_text(scenario_toml(resolved))
    (run_dir / ENVIRONMENT_FILE).write_text(json.dumps(environment(), indent=2))
    ticket = new_ticket(resolved, endpoint, run_dir.resolve(), launched=True)
    run = _Run(ticket, run_dir, spawn, watcher or Watcher())
    with Signals().handled() as signals, contextlib.ExitStack() as stack:
        coordinator = Coordinator(ticket)
        stack.callback(coordinator.close)
        if session is not None:
            stack.enter_context(published(ticket._replace(launched=False), session))
        stack.enter_context(run.children(live=live))
        status, reason = run.watch(coordinator, signals)
    if coordinator.epoch_ns is None:
        raise NeverStartedError(f"{reason} (logs in {run_dir / 'logs'})", status)
    return conclude(run_dir, ticket.run_id, status, reason)


def conclude(run_dir: Path, run_id: int, status: ExitStatus, reason: str) -> Outcome:
    """Finish what a dead recorder left undone, and write the summary."""
    if (run_dir / SPOOL).is_dir() or not (run_dir / RECORD).is_dir():
        record = finish_record(run_dir)
        from cosim.recorder import write_view  # imports rerun, which a good run does not need here

        write_view(record, run_dir, run_id)
    else:
        record = load_record(run_dir)
    summary = summarise(record, int(status), reason)
    (run_dir / SUMMARY_FILE).write_text(dumps(summary))
    return Outcome(run_dir, status, reason, summary)


def reopen(run_dir: Path) -> Outcome:
    """Return the outcome of an earlier run; finish its record if nobody did.

    Raises:
        CallerError: it is not a run directory.
    """
    if not (run_dir / SCENARIO_FILE).is_file():
        raise CallerError(f"{run_dir}: not a run directory (no {SCENARIO_FILE})")
    path = run_dir / SUMMARY_FILE
    if not path.is_file():
        return conclude(run_dir, 0, ExitStatus.FAILED, "the launcher did not live to see the end")
    summary = json.loads(path.read_text())
    end = summary["exit"]
    return Outcome(run_dir, ExitStatus(end["status"]), end["reason"], summary)


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
        patience_s = float("inf")
        while not self._over(coordinator, stopping=verdict is not None):
            coordinator.poll()
            now_s = time.monotonic()
            if coordinator.epoch_ns is None:
                missing = tuple(r for r in coordinator.missing() if r not in self._spawn)
                if missing != told:
                    told = missing
                    self._watcher.waiting(missing)
            elif patience_s == float("inf"):
                _point_to_latest(self._run_dir)
                self._watcher.started(self._run_dir)
                patience_s = now_s + scenario.horizon_s / scenario.speed + _OVERTIME_S
            if (account := coordinator.progress()) is not None:
                self._watcher.progress(account)
            if verdict is None:
                verdict = self._trouble(coordinator, signals)
                if verdict is None and now_s > patience_s:
                    verdict = (ExitStatus.FAILED, "the run did not end at its horizon")
                if verdict is not None:
                    coordinator.stop(verdict[1])
                    patience_s = now_s + _STOP_PATIENCE_S
            elif now_s > patience_s:
                break
            time.sleep(_POLL_S)
        return verdict or self._trouble(coordinator, signals) or (ExitStatus.OK, HORIZON)

    def _start(self, role: str, *, live: bool) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", _MODULES[role]]
        if role == RECORDER and live:
            command.append("--live")
        with (self._run_dir / "logs" / f"{role}.log").open("w") as log:
            child = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                text=True,
                start_new_session=True,  # a Ctrl-C is the launcher's to handle
                env=os.environ | {TICKET_ON_STDIN: "1", "OPENBLAS_NUM_THREADS": "1"},
            )
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
            return signals.status, f"stopped by {signal.Signals(signals.received).name}"
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
            return ExitStatus.FAILED, f"{role} died: killed by {signal.Signals(-code).name}"
        lines = (self._run_dir / "logs" / f"{role}.log").read_text().strip().splitlines()
        said = lines[-1].removeprefix(f"noack {role}: ") if lines else f"exit status {code}"
        known = code in (ExitStatus.FAILED, ExitStatus.CALLER)
        return ExitStatus(code) if known else ExitStatus.FAILED, f"{role}: {said}"


def latest_run(runs: Path) -> Path:
    """Return the newest run directory below ``runs``.

    Raises:
        CallerError: there is none.
    """
    link = runs / LATEST
    if not link.is_dir():
        raise CallerError(f"{runs}: no run yet; `noack demo` makes one")
    return link.resolve()
