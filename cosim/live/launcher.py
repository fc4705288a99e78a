"""The launcher: starts the processes of a run, follows them, and ends the run.

Read :func:`launch` first, from top to bottom. It makes numbers of the scenario
(``noack/scenario/resolution.py``), forks the processes (``processes/child_processes.py``), opens the
control plane (``coordination/coordinator.py``), and sends each process the run descriptor, which has
the scenario. A process asks for admission (``noack/runtime/join_run.py``), makes its machines, binds
its socket, and waits at the start barrier (``noack/runtime/run_process.py``). When all wait there, the
coordinator sends them the addresses and the common epoch, and each drives its machines.

``_Run.watch`` follows the run. When a process fails, the launcher stops the run, says which process
failed and why, and leaves a run directory with everything that was recorded.
"""

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from threading import Thread

from cosim.live.coordination import remote_access
from cosim.live.coordination.coordinator import Coordinator
from cosim.live.disk_space import require_disk_space
from cosim.live.monitoring.run_observers import RunObserver, RunObservers, observers_of_extensions
from cosim.live.processes.child_processes import ChildProcesses, EndReason
from cosim.live.processes.early_certificates import EarlyCertificates, LaunchedEnding
from cosim.live.wait_limit import WaitLimit
from cosim.record.run_directory import (
    PROCESSES_FILE,
    EndingFile,
    active_run,
    how_to_complete,
    new_run_dir,
    point_to_latest,
    write_environment,
)
from cosim.record.run_scenario import write_scenario
from netem.core.command_line import Signals, StopRequestError, stop_reason
from netem.core.errors import ExitStatus, MachineError, NeverStartedError, NoackError
from netem.core.file_access import remove_folder, write_whole
from noack.protocol.roles import RECORDER, ROLES
from noack.runtime.active_runs import registered_run, run_name
from noack.runtime.end_reasons import HORIZON
from noack.runtime.run_descriptor import RunAccess, RunDescriptor, descriptor_file, new_access, new_descriptor
from noack.scenario.resolution import ResolvedRun, resolve_run
from noack.scenario.run_sections import ClocksSection
from noack.scenario.scenario import Scenario

_STOP_TIMEOUT_S = 15.0
"""Wall time that the processes of a stopped run have to end."""
_STOPPED_S = 15.0
"""Wall time after which a run ends whose process was stopped, and not continued."""
DEFAULT_START_S = 30.0
"""Wall time within which all processes have to be ready, if the scenario gives none."""
_POLL_S, _STARTING_POLL_S = 0.01, 0.002
_LONGEST_WAIT_S = 1.0
"""What a turn of the launcher counts at most in its limits."""
_EARLY_CERTIFICATES_S = 5.0
"""Wall time of a run during which a process computes its certificates; in less, it hardly starts."""
_OVERTIME_S, _OVERTIME_SHARE = 20.0, 0.2
"""After the horizon: the recorder writes the record, and a long run has many rows."""


def launch(
    scenario: Scenario,
    runs: Path,
    *,
    spawn: Sequence[str] = ROLES,
    session: str | None = None,
    live: bool = False,
    fork: bool = False,
    observers: Sequence[RunObserver] = (),
    listening: remote_access.ListenSettings | None = None,
) -> LaunchedEnding:
    """Run a scenario; :func:`cosim.live.finalize.finalize` completes its record.

    Args:
        scenario: as loaded; it is resolved here.
        runs: where run directories are made.
        spawn: the roles to launch; the others are started by hand and join by ``session``.
        session: session name for processes started by hand.
        live: show the run in a viewer while it runs.
        fork: fork this process, which is a command and has one thread, to make the others.
        observers: who follows the run; those of extensions do so, too.
        listening: how processes on other hosts join.

    Raises:
        CallerError, MachineError: the run could not be prepared.
        NeverStartedError, StopRequestError: not all processes were ready; a second signal came.
    """
    began_ns = time.monotonic_ns()
    with contextlib.ExitStack() as stack:
        if listening is not None:  # the run directory says how far the clocks may be off
            scenario = scenario.model_copy(update={"clocks": scenario.clocks or ClocksSection()})
        resolved = resolve_run(scenario)
        require_disk_space(resolved.step_bytes, runs)
        run_dir = new_run_dir(runs, scenario.name)
        signals = stack.enter_context(_stop_signals(run_dir))
        children = ChildProcesses(run_dir, spawn, live=live, fork=fork)
        stack.callback(children.end)
        with _no_directory_if_refused(run_dir):
            children.start()  # before this process has threads, and files that a fork would inherit
        resolved = write_scenario(resolved, run_dir)
        access = new_access(run_dir.resolve(), launched=True)
        stack.enter_context(active_run(run_dir))
        ending = stack.enter_context(EndingFile(run_dir))
        _publish_run(stack, access, session)  # first: its file leads to a killed run's socket
        with _no_directory_if_refused(run_dir):
            coordinator, descriptor = _coordinate(stack, access, resolved, spawn, session, listening)
        certificates = stack.enter_context(EarlyCertificates())
        told = RunObservers([*observers, *observers_of_extensions(resolved.scenario)])
        if listening is not None:
            told.tell(lambda observer: observer.listening(listening))
        stack.callback(children.end)  # before all else ends
        children.send(descriptor)
        run = _Run(resolved, access.run_id, run_dir, coordinator, children, told, certificates)
        status, reason = run.watch(signals, ending.store)
        if coordinator.epoch_ns is None:
            raise NeverStartedError(f"{reason} (logs in {run_dir / 'logs'})", status)
        startup_s = (coordinator.epoch_ns - began_ns) * 1e-9
        ending.store(status, reason, startup_s)
    return LaunchedEnding(run_dir, access.run_id, status, reason, startup_s, certificates=certificates.known)


def _coordinate(
    stack: contextlib.ExitStack,
    access: RunAccess,
    run: ResolvedRun,
    spawn: Sequence[str],
    session: str | None,
    listening: remote_access.ListenSettings | None,
) -> tuple[Coordinator, RunDescriptor]:
    """Open the control plane, also to other hosts if the run is ``listening``; it closes with the stack.

    Returns:
        The coordinator, and the run descriptor for the processes of this host.
    """
    own_end, clock = access, None
    if listening is not None:
        clock = remote_access.own_clock(run.scenario.clocks or ClocksSection())
        remote_access.require_free(listening.address)
        own_end = stack.enter_context(remote_access.credentials(listening, access, run.scenario))
        access = access.model_copy(update={"host": listening.address[0]})
    coordinator = Coordinator(own_end, run, spawn, clock)
    stack.callback(coordinator.close)
    descriptor = new_descriptor(access, run.scenario)
    if session is not None:
        by_hand = descriptor.model_copy(update={"launched": False})
        stack.enter_context(descriptor_file(by_hand, session))
    return coordinator, descriptor


@contextlib.contextmanager
def _no_directory_if_refused(run_dir: Path) -> Iterator[None]:
    """Remove the run directory if an error says that the run cannot be joined in the requested way."""
    try:
        yield
    except NoackError:
        remove_folder(run_dir)
        raise


@contextlib.contextmanager
def _stop_signals(run_dir: Path) -> Iterator[Signals]:
    """Handle signals; if a second one ends the launcher, say where the incomplete record is."""
    with Signals().handled() as signals:
        try:
            yield signals
        except SystemExit:
            if signals.received is None:
                raise
            error = StopRequestError(signals.received)
            error.add_note(how_to_complete(run_dir))
            raise error from None


def _publish_run(stack: contextlib.ExitStack, access: RunAccess, session: str | None) -> None:
    """Let `noack set` find the run; without that the run goes on."""
    try:
        stack.enter_context(registered_run(access, session))
    except NoackError as error:
        print(f"noack: warning: `noack set` cannot reach this run: {error}", file=sys.stderr)


class _Run:
    """Follows a run from the start of its processes to their end."""

    def __init__(
        self,
        resolved: ResolvedRun,
        run_id: int,
        run_dir: Path,
        coordinator: Coordinator,
        children: ChildProcesses,
        observers: RunObservers,
        certificates: EarlyCertificates,
    ) -> None:
        self._wall_s, self._horizon_ns = resolved.wall_s, resolved.scenario.timing.horizon_ns
        self._run_id, self._run_dir = run_id, run_dir
        self._coordinator = coordinator
        self._children = children
        self._observers, self._certificates = observers, certificates
        self._by_hand = [role for role in ROLES if role not in children]
        self._missing: tuple[str, ...] = ()
        self._has_started = self._has_ended = False
        self._last_s = self._next_look_s = time.monotonic()
        self._stopped_since_s: dict[str, float] = {}
        """Since when launched processes have been stopped, by role."""
        start_within_s = resolved.scenario.start_within_s
        if start_within_s is None:
            start_within_s = float("inf") if self._by_hand else DEFAULT_START_S
        self._limit = WaitLimit(start_within_s)
        """How long the launcher still waits: for the start, for the end, or for the stop."""

    def watch(self, signals: Signals, store: Callable[[ExitStatus, str], None]) -> EndReason:
        """Follow the run to its end; return its exit status and the reason of the end.

        ``store`` is called with the result of a run that ends early, before its processes end.
        """
        early_end = self._follow(signals)
        if early_end is not None:
            store(*early_end)
            self._stop(early_end.reason)
        self._notify_progress()  # the last report may have arrived with the end
        return early_end or _signalled(signals) or self._failure() or EndReason(ExitStatus.OK, HORIZON)

    def _follow(self, signals: Signals) -> EndReason | None:
        """Follow the run until its processes have ended; return why it must end early, if it must."""
        while self._children.running() or not all(map(self._coordinator.is_over, self._by_hand)):
            self._advance(waits=not self._is_in_loop())
            if self._coordinator.epoch_ns is None:
                self._notify_missing()
            if (early_end := _signalled(signals) or self._failure()) is not None:
                return early_end
            if self._limit.is_reached:
                return EndReason(ExitStatus.FAILED, self._overdue())
        return None

    def _stop(self, reason: str) -> None:
        """Stop the processes, and wait for their end; not for one that is frozen, which never exits."""
        self._coordinator.stop(reason)
        if self._has_started:
            self._observers.tell(lambda observer: observer.stopping(reason))
        self._limit = WaitLimit(_STOP_TIMEOUT_S)
        while (
            set(self._children.running()) - self._coordinator.failures().keys() - self._stopped_since_s.keys()
        ):
            self._advance(waits=True)
            if self._limit.is_reached:
                return

    def _advance(self, *, waits: bool) -> None:
        """Handle messages, do what is due, and sleep a moment; ``waits``: it counts for the limit."""
        self._coordinator.poll()
        self._follow_phase()
        time.sleep(_POLL_S if self._has_started else _STARTING_POLL_S)
        last_s, self._last_s = self._last_s, time.monotonic()
        if waits:
            # Not the time during which this process was stopped.
            self._limit.wait(min(self._last_s - last_s, _LONGEST_WAIT_S), os.getloadavg()[0])
        if self._last_s >= self._next_look_s:
            self._next_look_s = self._last_s + 1.0
            since_s = self._stopped_since_s
            self._stopped_since_s = {
                role: since_s.get(role, self._last_s) for role in self._children.stopped()
            }

    def _follow_phase(self) -> None:
        """Do what is due once: when the loop starts, and when it has ended; tell of the progress."""
        if self._coordinator.epoch_ns is not None and not self._has_started:
            self._has_started = True
            # Now, as nothing waits for the launcher: the versions of all packages take 0.02 s.
            write_environment(self._run_dir, "live", run_name(self._run_id))
            self._write_processes()
            point_to_latest(self._run_dir)
            self._observers.tell(lambda observer: observer.started(self._run_dir))
            if self._wall_s >= _EARLY_CERTIFICATES_S:
                self._certificates.start(self._run_dir)
            self._limit = WaitLimit(overtime_s(self._wall_s))
        elif self._has_started and not self._has_ended and not self._is_in_loop():
            self._has_ended = True  # while the processes end: the imports take 0.3 s
            Thread(target=import_module, args=("cosim.live.finalize",), daemon=True).start()
        self._notify_progress()

    def _failure(self) -> EndReason | None:
        """How a process failed; None if none did."""
        exited = self._children.failures(self._coordinator.await_reported_failure)
        running = self._children.running()
        failures = {
            role: EndReason(ExitStatus.FAILED, why)
            for role, why in self._coordinator.failures().items()
            # The exit status of a launched process explains more than its report, or its lost connection.
            if not (role in running and self._coordinator.is_exiting(role))
            and not (role in self._children and role not in running and not self._coordinator.has_ended(role))
        }
        if RECORDER in running and self._coordinator.now_ns() >= self._horizon_ns:
            failures.pop(RECORDER, None)  # sorting a long record, it may not respond
        for role, since_s in self._stopped_since_s.items():
            if role in failures or self._last_s - since_s > _STOPPED_S:
                failures[role] = EndReason(ExitStatus.FAILED, _stopped_text([role]))
        return next(iter((failures | exited).values()), None)

    def _is_in_loop(self) -> bool:
        """Whether the run has started and has not reached its horizon."""
        started = self._coordinator.epoch_ns is not None
        return started and self._coordinator.now_ns() < self._horizon_ns

    def _write_processes(self) -> None:
        """Write which processes joined, for `noack summary --add`; without that the run goes on."""
        text = json.dumps(self._coordinator.instances(), indent=2)
        with contextlib.suppress(MachineError):
            write_whole(self._run_dir / PROCESSES_FILE, text, make_folder=False)

    def _notify_missing(self) -> None:
        missing = tuple(role for role in self._coordinator.missing() if role in self._by_hand)
        if missing != self._missing:
            self._missing = missing
            self._observers.tell(lambda observer: observer.waiting(missing))

    def _notify_progress(self) -> None:
        if (progress := self._coordinator.progress()) is not None:
            self._observers.tell(lambda observer: observer.progress(progress))
        while self._coordinator.notices:
            self._notify_line(self._coordinator.notices.pop(0))

    def _notify_line(self, line: str) -> None:
        self._observers.tell(lambda observer: observer.notice(line))

    def _overdue(self) -> str:
        if self._stopped_since_s:
            return _stopped_text(self._stopped_since_s)
        if self._coordinator.epoch_ns is None:
            return self._not_ready()
        # One that is lost, too: the recorder may not respond while it sorts a long record.
        silent = [role for role in ROLES if not self._coordinator.has_ended(role)]
        # The recorder waits for the others.
        silent = [role for role in silent if role != RECORDER] or silent
        failure = f"there is no report from {', '.join(silent)}"
        if not silent:
            failure = f"{', '.join(self._children.running())} reported the end, but did not exit"
        return f"the run did not end at its horizon: {failure}; {self._limit.explain_end()}"

    def _not_ready(self) -> str:
        """Why the run did not start in time."""
        missing = self._coordinator.missing()
        by_hand = [role for role in missing if role in self._by_hand]
        # Those may wait for a person: neither the load nor a limit is the reason.
        reasons = [self._limit.explain_missing(by_hand)] if by_hand else []
        launched = [role for role in missing if role not in by_hand]
        reasons += [self._limit.explain_start(launched)] if launched else []
        return "; ".join(reasons)


def _stopped_text(roles: Collection[str]) -> str:
    """Return that processes are stopped, and by what."""
    are = "is" if len(roles) == 1 else "are"
    return f"{', '.join(roles)} {are} stopped (state T), by a signal such as SIGSTOP or by a debugger"


def _signalled(signals: Signals) -> EndReason | None:
    if signals.received is None:
        return None
    return EndReason(signals.status, stop_reason(signals.received))


def overtime_s(run_s: float) -> float:
    """How long the processes of a run of ``run_s`` of wall time may take to end after it."""
    return run_s * _OVERTIME_SHARE + _OVERTIME_S
