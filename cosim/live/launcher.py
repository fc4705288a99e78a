"""The launcher: starts the processes of a run, follows them, and ends the run.

When a process fails, the launcher names it, stops the run or restarts the process, and leaves a run
directory with everything that was recorded.
"""

import contextlib
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

from cosim.live.child_processes import ChildProcesses, Failure
from cosim.live.coordinator import Coordinator
from cosim.live.disk_space import require_disk_space
from cosim.live.fork_server import ForkServer, fork_server
from cosim.live.remote_hosts import RemoteStart
from cosim.live.restart_policy import RestartPolicy
from cosim.live.wait_limit import DEFAULT_S, WaitLimit
from cosim.record.environment import write_environment
from cosim.record.run_directory import (
    PROCESSES_FILE,
    active_run,
    new_run_dir,
    point_to_latest,
    write_scenario,
)
from cosim.record.run_ending import EndingFile, RunEnding
from noack.config.resolution import resolve_run, resolved_loops
from noack.config.scenario import Scenario
from noack.core.errors import ExitStatus, MachineError, NeverStartedError, NoackError
from noack.core.file_access import write_whole
from noack.protocol.topology import PLANT, RECORDER, ROLES
from noack.runtime import run_registry
from noack.runtime.address import text_of
from noack.runtime.control_plane import run_name
from noack.runtime.invitation import invitation_file
from noack.runtime.join_ticket import Ticket, new_ticket, published
from noack.runtime.life_cycle import HORIZON
from noack.runtime.signals import Signals, stop_reason

if TYPE_CHECKING:
    from cosim.live.remote_access import Listening

_POLL_S, _STARTING_POLL_S = 0.01, 0.002
_STOP_TIMEOUT_S = 15.0
_OVERTIME_S, _OVERTIME_SHARE = 20.0, 0.2
"""After the horizon: the recorder writes the record, and a long run has many rows."""


@dataclass(frozen=True)
class Watcher:
    """Callbacks of a launched run; each must return at once."""

    waiting: Callable[[Sequence[str]], None] = lambda roles: None
    listening: "Callable[[str, Listening], None]" = lambda address, how: None
    started: Callable[[Path], None] = lambda run_dir: None
    failed: Callable[[str, float, str | None], None] = lambda why, t_s, by_hand: None
    restarted: Callable[[str, float], None] = lambda role, t_s: None
    progress: Callable[[dict[str, Any]], None] = lambda progress: None
    stopping: Callable[[str], None] = lambda why: None
    notice: Callable[[str], None] = lambda line: None


def joint_watcher(watchers: Sequence[Watcher]) -> Watcher:
    """Return a watcher that calls others in order; after an OSError, no more of that one."""
    left = list(watchers)

    def call(name: str) -> Callable[..., None]:
        def each(*arguments: object) -> None:
            for one in [*left]:
                try:
                    getattr(one, name)(*arguments)
                except OSError:  # nobody reads its output any more
                    left.remove(one)

        return each

    return Watcher(*(call(field.name) for field in fields(Watcher)))


def later_watcher(open_watcher: Callable[[], Watcher]) -> Watcher:
    """Return a watcher that is opened at its first callback, after the start of the processes."""
    opened = cache(open_watcher)

    def call(name: str) -> Callable[..., None]:
        return lambda *arguments: getattr(opened(), name)(*arguments)

    return Watcher(*(call(field.name) for field in fields(Watcher)))


def launch(
    scenario: Scenario,
    runs: Path,
    *,
    spawn: Sequence[str] = ROLES,
    session: str | None = None,
    live: bool = False,
    watcher: Watcher | None = None,
    server: ForkServer | None = None,
    listening: "Listening | None" = None,
) -> RunEnding:
    """Run a scenario; :func:`cosim.live.finalize.finalize` completes its record.

    Args:
        scenario: as loaded; it is resolved here.
        runs: where run directories are made.
        spawn: the roles to launch; the others are started by hand and join by ``session``.
        session: session name for processes started by hand.
        live: show the run in a viewer while it runs.
        watcher: callbacks.
        server: starts the processes; by default a new one.
        listening: how processes on other hosts join, and which of ``spawn`` run there.

    Raises:
        CallerError, MachineError: the run could not be prepared.
        NeverStartedError: the run ended before all processes were ready.
    """
    began_ns = time.monotonic_ns()
    if listening is not None:
        from cosim.live.remote_access import open_to_hosts, with_clocks  # asyncio and TLS

        scenario = with_clocks(scenario)
    with contextlib.ExitStack() as stack:
        server = server or stack.enter_context(fork_server())
        loops = resolved_loops(scenario)
        resolved = resolve_run(scenario)
        require_disk_space(loops, runs)
        if PLANT in spawn:
            # Compile now: the start barrier has a time limit.
            for system in {repr(loop.plant.system): loop.plant.system for loop in loops}.values():
                system.prepare()
        away = {} if listening is None else listening.hosts
        here = [role for role in spawn if role not in away]
        signals = stack.enter_context(Signals().handled())
        run_dir = new_run_dir(runs, resolved.name)
        resolved = write_scenario(resolved, run_dir)
        ticket = new_ticket(resolved, run_dir.resolve(), launched=True)
        stack.enter_context(active_run(run_dir))
        ending = stack.enter_context(EndingFile(run_dir))
        _publish_run(stack, ticket, session)  # first: its file leads to a killed run's socket
        coordinator = Coordinator(ticket, here)
        stack.callback(coordinator.close)
        watcher, remote = watcher or Watcher(), None
        notices: SimpleQueue[str] = SimpleQueue()
        with _no_directory_if_refused(run_dir):
            if listening is not None:
                ticket = ticket.model_copy(update={"host": listening.address[0]})
                opened = stack.enter_context(open_to_hosts(listening, ticket, coordinator))
                notices = opened.notices
                remote = RemoteStart(away, opened.invitation.model_dump_json())
            if session is not None:
                by_hand = ticket.model_copy(update={"launched": False})
                stack.enter_context(published(by_hand, session))
            if listening is not None:
                if listening.invitation is not None:  # last: it replaces that of an earlier run
                    stack.enter_context(invitation_file(listening.invitation, opened.invitation))
                watcher.listening(text_of(opened.address), listening)
        children = ChildProcesses(ticket, run_dir, spawn, server, remote)
        stack.enter_context(children.started(live=live))
        run = _Run(ticket, run_dir, coordinator, children, watcher, notices)
        status, reason = run.watch(signals, ending.store)
        if coordinator.epoch_ns is None:
            raise NeverStartedError(f"{reason} (logs in {run_dir / 'logs'})", status)
        startup_s = (coordinator.epoch_ns - began_ns) * 1e-9
        ending.store(status, reason, startup_s)
    return RunEnding(run_dir, ticket.run_id, status, reason, startup_s)


@contextlib.contextmanager
def _no_directory_if_refused(run_dir: Path) -> Iterator[None]:
    """Remove the run directory if an error says that the run cannot be joined as was asked for."""
    try:
        yield
    except NoackError:
        shutil.rmtree(run_dir, ignore_errors=True)
        raise


def _publish_run(stack: contextlib.ExitStack, ticket: Ticket, session: str | None) -> None:
    """Let `noack set` find the run; without that the run goes on."""
    try:
        stack.enter_context(run_registry.published(ticket, session))
    except NoackError as error:
        print(f"noack: warning: `noack set` cannot reach this run: {error}", file=sys.stderr)


class _Run:
    """Follows a run from the start of its processes to their end."""

    def __init__(
        self,
        ticket: Ticket,
        run_dir: Path,
        coordinator: Coordinator,
        children: ChildProcesses,
        watcher: Watcher,
        notices: SimpleQueue[str],
    ) -> None:
        self._notices = notices
        self._scenario, self._run_id = ticket.scenario, ticket.run_id
        self._run_dir = run_dir
        self._coordinator = coordinator
        self._children = children
        self._watcher = watcher
        self._by_hand = [role for role in ROLES if role not in children]
        self._missing: tuple[str, ...] = ()
        self._limit = WaitLimit(self._start_within_s())
        """How long the launcher still waits: for the start, for the end, or for the stop."""
        self._policy = RestartPolicy(
            ticket.scenario,
            coordinator,
            children,
            lambda *failure: self._notify("failed", *failure),
            lambda *restart: self._notify("restarted", *restart),
        )

    def watch(self, signals: Signals, store: Callable[[ExitStatus, str], None]) -> Failure:
        """Follow the run to its end; return its exit status and the reason of the end.

        ``store`` is called with the result of a run that ends early, before its processes end.
        """
        result: Failure | None = None
        last_s, started, joined = time.monotonic(), False, 0
        while not self._is_over(stopping=result is not None):
            self._coordinator.poll()
            now_s = time.monotonic()
            if result is not None or not self._is_in_loop():
                self._limit.wait(now_s - last_s, os.getloadavg()[0])
            last_s = now_s
            if self._coordinator.epoch_ns is None:
                if result is None:
                    self._notify_missing()
            elif not started:
                started = True
                # Now, as nothing waits for the launcher: the versions of all packages take 0.02 s.
                write_environment(self._run_dir, "live", run_name(self._run_id))
                point_to_latest(self._run_dir)
                self._notify("started", self._run_dir)
                self._limit = WaitLimit(overtime_s(self._scenario.horizon_s / self._scenario.speed))
            if len(self._coordinator.joined) > joined:
                joined = len(self._coordinator.joined)
                self._write_processes()
            self._notify_progress()
            if result is None:
                result = _signalled(signals) or self._policy.check()
                if result is None and self._limit.is_reached:
                    result = (ExitStatus.FAILED, self._overdue())
                if result is not None:
                    store(*result)
                    self._coordinator.stop(result[1])
                    if started:
                        self._notify("stopping", result[1])
                    self._limit = WaitLimit(_STOP_TIMEOUT_S)
            elif self._limit.is_reached:
                break
            time.sleep(_POLL_S if started else _STARTING_POLL_S)
        self._notify_progress()  # the last report may have arrived with the end
        return (
            result
            or _signalled(signals)
            or self._policy.check()
            or self._policy.unfinished()
            or (ExitStatus.OK, HORIZON)
        )

    def _is_over(self, *, stopping: bool) -> bool:
        running = self._children.running()
        if running:
            # A frozen process never exits; the run does not wait for it.
            failures = self._coordinator.failures()
            return stopping and all(role in failures for role in running)
        return stopping or all(self._coordinator.is_over(role) for role in self._by_hand)

    def _is_in_loop(self) -> bool:
        """Whether the run has started and has not reached its horizon."""
        started = self._coordinator.epoch_ns is not None
        return started and self._coordinator.now_ns() < self._scenario.timing.horizon_ns

    def _write_processes(self) -> None:
        """Write which processes joined, for `noack collect`; without that the run goes on."""
        text = json.dumps(self._coordinator.joined, indent=2)
        with contextlib.suppress(MachineError):
            write_whole(self._run_dir / PROCESSES_FILE, text, make_folder=False)

    def _notify_missing(self) -> None:
        missing = tuple(role for role in self._coordinator.missing() if role in self._by_hand)
        if missing != self._missing:
            self._missing = missing
            self._notify("waiting", missing)

    def _notify_progress(self) -> None:
        if (progress := self._coordinator.progress()) is not None:
            self._notify("progress", progress)
        while not self._notices.empty():
            self._notify("notice", self._notices.get_nowait())

    def _notify(self, callback: str, *arguments: object) -> None:
        try:
            getattr(self._watcher, callback)(*arguments)
        except OSError:  # nobody reads the output any more; the run goes on
            self._watcher = Watcher()

    def _start_within_s(self) -> float:
        given_s = self._scenario.start_within_s
        if given_s is None:
            return float("inf") if self._by_hand else DEFAULT_S
        return given_s

    def _overdue(self) -> str:
        if self._coordinator.epoch_ns is None:
            return f"{', '.join(self._coordinator.missing())} {self._limit.explain_start()}"
        # One that is lost, too: the recorder may not respond while it sorts a long record.
        silent = [role for role in ROLES if not self._coordinator.has_ended(role)]
        # The recorder waits for the others.
        silent = [role for role in silent if role != RECORDER] or silent
        what = f"no report from {', '.join(silent)}"
        if not silent:
            what = f"{', '.join(self._children.running())} reported the end, but did not exit"
        return f"the run did not end at its horizon: {what}, {self._limit.explain_end()}"


def _signalled(signals: Signals) -> Failure | None:
    if signals.received is None:
        return None
    return signals.status, stop_reason(signals.received)


def overtime_s(run_s: float) -> float:
    """How long the processes of a run of ``run_s`` of wall time may take to end after it."""
    return run_s * _OVERTIME_SHARE + _OVERTIME_S
