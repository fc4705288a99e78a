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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.live.coordinator import Coordinator
from cosim.live.disk_space import require_disk_space
from cosim.live.start_limit import DEFAULT_S, StartLimit
from cosim.record.environment import write_environment
from cosim.record.run_directory import in_flight, new_run_dir, point_to_latest, write_scenario
from cosim.record.run_ending import EndingFile, RunEnding
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.core.errors import CallerError, ExitStatus, MachineError, NeverStartedError
from noack.core.python_process import python_command
from noack.protocol.topology import PLANT, RECORDER, ROLES
from noack.runtime import run_registry
from noack.runtime.join_ticket import Ticket, new_ticket, published
from noack.runtime.process_entry import TICKET_ON_STDIN
from noack.runtime.process_life import HORIZON
from noack.runtime.signals import Signals
from noack.runtime.udp_sockets import LOOPBACK, free_tcp_port, require_free_tcp_port

_MODULES = {
    "recorder": "cosim.live.recorder",
    "netem": "netem",
    "plant": "plant_server",
    "sensor": "sensor_node",
    "controller": "controller_node",
}
_STOPPED: Mapping[int, str] = {
    signal.SIGINT: "stopped by the user",
    signal.SIGTERM: "stopped on request",
    signal.SIGHUP: "stopped as its terminal was closed",
}
_POLL_S = 0.01
_STOP_PATIENCE_S = 15.0
_OVERTIME_S, _OVERTIME_SHARE = 20.0, 0.2
"""After the horizon: the recorder puts the rows in order, of which a long run has many."""
REJOIN_BY_HAND_S = 60.0


@dataclass(frozen=True)
class Watcher:
    """What the launcher tells while it works; every callback returns at once."""

    waiting: Callable[[Sequence[str]], None] = lambda roles: None
    started: Callable[[Path], None] = lambda run_dir: None
    lost: Callable[[str, float, str | None], None] = lambda why, t_s, by_hand: None
    back: Callable[[str, float], None] = lambda role, t_s: None
    progress: Callable[[dict[str, Any]], None] = lambda account: None


def launch(
    scenario: Scenario,
    runs: Path,
    *,
    spawn: Sequence[str] = ROLES,
    session: str | None = None,
    live: bool = False,
    watcher: Watcher | None = None,
) -> RunEnding:
    """Run a scenario; :func:`cosim.live.finalize.finalize` makes its record whole.

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
    require_disk_space(resolved, runs)
    control = resolved.ports.control
    if control:
        require_free_tcp_port(control, "ports.control")
    if PLANT in spawn:
        resolved.plant.system.prepare()  # nobody waits long for a process at the start
    endpoint = f"tcp/{LOOPBACK}:{control or free_tcp_port()}"
    run_dir = new_run_dir(runs, resolved.name)
    resolved = write_scenario(resolved, run_dir)
    write_environment(run_dir, "live")
    ticket = new_ticket(resolved, endpoint, run_dir.resolve(), launched=True)
    run = _Run(ticket, run_dir, spawn, watcher or Watcher())
    with Signals().handled() as signals, contextlib.ExitStack() as stack:
        stack.enter_context(in_flight(run_dir))
        ending = stack.enter_context(EndingFile(run_dir))
        coordinator = Coordinator(ticket)
        stack.callback(coordinator.close)
        if session is not None:
            stack.enter_context(published(ticket._replace(launched=False), session))
        _publish(stack, ticket, session)
        stack.enter_context(run.children(live=live))
        status, reason = run.watch(coordinator, signals, ending.store)
        if coordinator.epoch_ns is None:
            raise NeverStartedError(f"{reason} (logs in {run_dir / 'logs'})", status)
        startup_s = (coordinator.epoch_ns - began_ns) * 1e-9
        ending.store(status, reason, startup_s)
    return RunEnding(run_dir, ticket.run_id, status, reason, startup_s)


def _publish(stack: contextlib.ExitStack, ticket: Ticket, session: str | None) -> None:
    """Let `noack set` find the run; one that it cannot find goes on all the same."""
    try:
        stack.enter_context(run_registry.published(ticket, session))
    except (CallerError, OSError) as error:
        print(f"noack: warning: `noack set` cannot reach this run: {error}", file=sys.stderr)


@dataclass(frozen=True)
class _Lost:
    """A process of the loop that is gone, and may be followed by another."""

    why: str
    status: ExitStatus
    until_s: float
    """Reading of the monotonic clock until which it is waited for."""
    within_s: float


class _Run:
    def __init__(
        self, ticket: Ticket, run_dir: Path, spawn: Sequence[str], watcher: Watcher
    ) -> None:
        self._ticket = ticket
        self._run_dir = run_dir
        self._spawn = spawn
        self._watcher = watcher
        self._children: dict[str, subprocess.Popen[str]] = {}
        self._lost: dict[str, _Lost] = {}

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
                _end(child)

    def watch(
        self,
        coordinator: Coordinator,
        signals: Signals,
        store: Callable[[ExitStatus, str], None],
    ) -> tuple[ExitStatus, str]:
        """Follow the run to its end; return its exit status and why it ended.

        Args:
            coordinator: of the run.
            signals: what ends it.
            store: is told why the run ends early, before its processes end.
        """
        scenario = self._ticket.scenario
        verdict: tuple[ExitStatus, str] | None = None
        told: tuple[str, ...] = ()
        limit = StartLimit(self._start_within_s())
        patience_s = float("inf")
        before_s = time.monotonic()
        started = False
        while not self._over(coordinator, stopping=verdict is not None):
            coordinator.poll()
            now_s = time.monotonic()
            if coordinator.epoch_ns is None:
                limit.wait(now_s - before_s, os.getloadavg()[0])
                before_s = now_s
                missing = tuple(r for r in coordinator.missing() if r not in self._spawn)
                if missing != told and verdict is None:
                    told = missing
                    self._tell(self._watcher.waiting, missing)
            elif not started:
                started = True
                point_to_latest(self._run_dir)
                self._tell(self._watcher.started, self._run_dir)
                patience_s = now_s + longest_s(scenario.horizon_s / scenario.speed)
            self._give_account(coordinator)
            if verdict is None:
                verdict = self._stopped(signals) or self._trouble(coordinator)
                if verdict is None and (now_s > patience_s or limit.is_reached):
                    verdict = (ExitStatus.FAILED, _overdue(coordinator, limit))
                if verdict is not None:
                    store(*verdict)
                    coordinator.stop(verdict[1])
                    patience_s = now_s + _STOP_PATIENCE_S
            elif now_s > patience_s:
                break
            time.sleep(_POLL_S)
        self._give_account(coordinator)  # the last one may have come with the end
        return (
            verdict
            or self._stopped(signals)
            or self._trouble(coordinator)
            or self._never_back()
            or (ExitStatus.OK, HORIZON)
        )

    def _give_account(self, coordinator: Coordinator) -> None:
        if (account := coordinator.progress()) is not None:
            self._tell(self._watcher.progress, account)

    def _tell(self, callback: Callable[..., None], *arguments: object) -> None:
        try:
            callback(*arguments)
        except OSError:  # whoever watched has gone; the run goes on
            self._watcher = Watcher()

    def _start(self, role: str, *, live: bool) -> subprocess.Popen[str]:
        command = python_command("-m", _MODULES[role])
        if role == RECORDER and live:
            command.append("--live")
        environment = os.environ | {
            TICKET_ON_STDIN: "1",
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONUTF8": "1",
            # What a busy moment took goes back to the system: glibc raises its own thresholds for
            # that with each large block unless they are given, and has an arena for each thread.
            "MIMALLOC_PURGE_DELAY": "0",
            "ARROW_DEFAULT_MEMORY_POOL": "system",
            "MALLOC_ARENA_MAX": "2",
            "MALLOC_MMAP_THRESHOLD_": "131072",
            "MALLOC_TRIM_THRESHOLD_": "131072",
        }
        try:
            with (self._run_dir / "logs" / f"{role}.log").open("a") as log:
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
            gone = coordinator.gone()
            return stopping and all(
                child.poll() is not None or role in gone for role, child in self._children.items()
            )
        others = [role for role in ROLES if role not in self._spawn]
        return stopping or all(coordinator.finished(role) for role in others)

    def _stopped(self, signals: Signals) -> tuple[ExitStatus, str] | None:
        if signals.received is None:
            return None
        name = _name(signals.received)
        return signals.status, f"{_STOPPED[signals.received]} ({name})"

    def _trouble(self, coordinator: Coordinator) -> tuple[ExitStatus, str] | None:
        """Why the run must end; None if it need not. Who died may be followed by another."""
        for role, lost in list(self._lost.items()):
            if coordinator.generation(role) is not None:
                del self._lost[role]
                self._tell(self._watcher.back, role, coordinator.now_ns() * 1e-9)
            elif (again := self._exited(role, coordinator)) is not None:
                return again[0], f"{lost.why}; started anew, {again[1]}"
            elif time.monotonic() > lost.until_s:
                return lost.status, f"{lost.why}; no other came within {lost.within_s:g} s"
        for role, (status, why) in self._casualties(coordinator).items():
            within_s = self._rejoin_within_s(role)
            over = coordinator.now_ns() >= self._ticket.scenario.timing.horizon_ns
            if coordinator.epoch_ns is None or over or role == PLANT or not within_s:
                return status, why
            if self._gave_up(role):  # so would another
                return status, why
            self._lost[role] = _Lost(why, status, time.monotonic() + within_s, within_s)
            spawned = role in self._spawn
            coordinator.expect(role, why, dead=spawned)
            self._tell(
                self._watcher.lost, why, coordinator.now_ns() * 1e-9, None if spawned else role
            )
            if spawned:
                _end(self._children[role])
                try:
                    self._children[role] = self._start(role, live=False)
                except MachineError as error:
                    return status, f"{why}; {error}"
        return None

    def _casualties(self, coordinator: Coordinator) -> dict[str, tuple[ExitStatus, str]]:
        """Who is gone that is not waited for, and why."""
        # The exit status of a process of ours says more than that it leaves.
        gone = {
            role: why
            for role, why in coordinator.gone().items()
            if not (self._is_running(role) and coordinator.is_leaving(role))
        }
        if self._over_its_record(coordinator):
            gone.pop(RECORDER, None)
        found = {role: (ExitStatus.FAILED, why) for role, why in gone.items()}
        found |= {
            role: how
            for role in self._children
            if (how := self._exited(role, coordinator)) is not None
        }
        return {role: how for role, how in found.items() if role not in self._lost}

    def _over_its_record(self, coordinator: Coordinator) -> bool:
        """Whether the recorder may be busy with a long record's end, and not hear its peers."""
        over = coordinator.now_ns() >= self._ticket.scenario.timing.horizon_ns
        return over and self._is_running(RECORDER)

    def _is_running(self, role: str) -> bool:
        """Whether a process of ours has not ended."""
        child = self._children.get(role)
        return child is not None and child.poll() is None

    def _rejoin_within_s(self, role: str) -> float:
        given_s = self._ticket.scenario.recovery.rejoin_within_s
        if given_s is None:
            return 0.0 if role in self._spawn else REJOIN_BY_HAND_S
        return given_s

    def _start_within_s(self) -> float:
        given_s = self._ticket.scenario.start_within_s
        if given_s is None:
            by_hand = any(role not in self._spawn for role in ROLES)
            return float("inf") if by_hand else DEFAULT_S
        return given_s

    def _never_back(self) -> tuple[ExitStatus, str] | None:
        for lost in self._lost.values():
            return lost.status, f"{lost.why}; no other came before the end"
        return None

    def _exited(self, role: str, coordinator: Coordinator) -> tuple[ExitStatus, str] | None:
        """How a process of ours failed; None if it did not."""
        child = self._children.get(role)
        code = None if child is None else child.poll()
        return None if not code else self._died(role, code, coordinator)

    def _gave_up(self, role: str) -> bool:
        """Whether a process of ours ended itself, and said why."""
        child = self._children.get(role)
        return child is not None and child.poll() in (ExitStatus.FAILED, ExitStatus.CALLER)

    def _died(self, role: str, code: int, coordinator: Coordinator) -> tuple[ExitStatus, str]:
        if code < 0:
            return ExitStatus.FAILED, f"{role} died: killed by {_name(-code)}"
        if code in (ExitStatus.INTERRUPTED, ExitStatus.TERMINATED):
            return ExitStatus.FAILED, f"{role} ended early: {_name(code - 128)}"
        known = code in (ExitStatus.FAILED, ExitStatus.CALLER)
        lines, own = self._logged(role), f"noack {role}: "
        # Libraries log there, too; and when the disk is full, nobody does.
        said = next((one.removeprefix(own) for one in lines[::-1] if one.startswith(own)), None)
        why = said or coordinator.last_words(role) or "".join(lines[-1:]) or f"exit status {code}"
        return ExitStatus(code) if known else ExitStatus.FAILED, f"{role}: {why}"

    def _logged(self, role: str) -> list[str]:
        log = self._run_dir / "logs" / f"{role}.log"
        try:
            return log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except OSError:  # somebody took the run's folder away
            return []


def longest_s(run_s: float) -> float:
    """How long a run of some wall time may take until everyone has left."""
    return run_s * (1 + _OVERTIME_SHARE) + _OVERTIME_S


def _overdue(coordinator: Coordinator, limit: StartLimit) -> str:
    if coordinator.epoch_ns is None:
        return f"{', '.join(coordinator.missing())} {limit.explain()}"
    here = [role for role in ROLES if not coordinator.finished(role)]
    # The recorder stays until the last of the others has left.
    held = [role for role in here if role != RECORDER] or here
    return f"the run did not end at its horizon: no end came from {', '.join(held)}"


def _end(child: subprocess.Popen[str]) -> None:
    """See a process off."""
    if child.poll() is None:
        child.kill()
    child.wait()
    if child.stdin is not None:
        with contextlib.suppress(OSError):
            child.stdin.close()


def _name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
