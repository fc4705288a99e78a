"""The coordinator of a run: admission, start barrier, changes of settings, liveliness, stop.

Read :meth:`Coordinator.poll` first: it handles what has arrived, in the order in which a process
sends it. ``change_requests.py`` has the changes of settings.
"""

import os
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from cosim.live.coordination.change_requests import ChangeRequests
from cosim.record.processes import kept_reports
from netem.core.clock import RunClock
from netem.core.errors import CallerError, PeerError
from netem.core.system_processes import cores
from noack.protocol.roles import COORDINATOR, LOOP_ROLES, ROLES
from noack.runtime.connections.zenoh_session import header_of, next_payload
from noack.runtime.control_messages import (
    Admission,
    AdmissionRequest,
    ClockError,
    JoinRequest,
    RunProgress,
    RunStart,
    parse_message,
)
from noack.runtime.control_plane import ControlPlane
from noack.runtime.end_reasons import HORIZON, LAUNCHED_LOST_S, LOST_AFTER_S
from noack.runtime.host_clocks import STATED, realtime_offset_ns, require_small_error
from noack.runtime.run_descriptor import RunAccess
from noack.scenario.resolution import ResolvedRun

_REPORT_GRACE_S = 0.3
"""A process's last message may arrive this much later than its exit is seen."""
_LOOK_S = 0.5
"""Time between two looks for reports on disk."""
_OWN_STOP_S = 1.0
"""A longer time between two polls is a stop of this process, during which no other could be found lost."""
_EXIT_GRACE_S = 5.0
"""By then a process has exited that has reported its end."""
_START_DELAY_NS, _LONG_START_DELAY_NS = 30_000_000, 100_000_000
"""From the last arrival to the common epoch: time for the message to reach all processes. The
longer one is for processes on other hosts, and for a loaded machine."""


@dataclass
class _Member:
    """A process that was admitted."""

    role: str
    instance: str
    lost_after_s: float
    """It is lost when its connection is not back after this time."""
    clock: ClockError | None
    """Of a host with another clock than the coordinator's."""
    address: tuple[str, int] | None = None
    query: zenoh.Query | None = None
    """Its unanswered join request, while it waits at the start barrier."""
    vanished_s: float | None = None
    """Reading of the monotonic clock when its connection broke; None while it is connected."""
    ended: str | None = None
    """Why it ended, by its own report."""
    ended_s: float = 0.0
    is_lost: bool = False
    """Whether its connection broke, and neither came back nor was followed by a report."""

    def is_missing(self, for_s: float = 0.0) -> bool:
        """Whether its connection has been broken for some time, without a report of its end."""
        if self.ended is not None or self.vanished_s is None:
            return False
        return time.monotonic() - self.vanished_s > for_s

    def failure(self) -> str | None:
        """Why it is over before its work was done; None if it is not over, or did its work."""
        if self.ended is not None:
            return None if self.ended == HORIZON else f"ended early: {self.ended}"
        return "stopped responding" if self.is_lost else None


class Coordinator:
    """The coordinator of one run.

    Args:
        access: of this end of the control plane.
        run: the run.
        launched: roles of the processes that the launcher has started.
        own_clock: how far this host's clock may be off, if processes of other hosts can join.

    Raises:
        PeerError: the control plane cannot be started.
    """

    def __init__(
        self,
        access: RunAccess,
        run: ResolvedRun,
        launched: Collection[str] = (),
        own_clock: ClockError | None = None,
    ) -> None:
        self._launched, self._own_clock = launched, own_clock
        self._clock_settings = run.scenario.clocks
        self.notices = [] if own_clock is None else [_clock_line("the clock of this host", own_clock)]
        """Lines for the person who watches the run, which have not been taken yet."""
        self.plane = ControlPlane(access, COORDINATOR, listen=True)
        session, key = self.plane.session, self.plane.key
        self._admissions = session.declare_queryable(key("admit", "*"), FifoChannel(64))
        self._joins = session.declare_queryable(key("join", "*"), FifoChannel(64))
        self._tokens = session.liveliness().declare_subscriber(key("alive", "*", "*"), RingChannel(256))
        self._ends = session.declare_subscriber(key("ended", "*", "*"), RingChannel(256))
        self._progress = session.declare_subscriber(key("progress"), RingChannel(1))
        self._change_queries = session.declare_queryable(key("runtime_parameters"), FifoChannel(64))
        self._changes = ChangeRequests(run, access.run_dir, self.plane)
        self._speed = run.scenario.speed
        self._clock: RunClock | None = None
        self._realtime_offset_ns = 0
        """This host's CLOCK_REALTIME minus its CLOCK_MONOTONIC, at the start of the run."""
        self._admitted: dict[tuple[str, str], _Member] = {}
        """By role and instance."""
        self._members: dict[str, _Member] = {}
        """The process of each role that waits at the start barrier, or has passed it."""
        self._reported: dict[str, str] = {}
        """Why processes ended, by role."""
        self._stopped: str | None = None
        self._run_dir = Path(access.run_dir)
        self._polled_s = self._next_look_s = time.monotonic()

    @property
    def epoch_ns(self) -> int | None:
        """Monotonic clock reading at simulated time 0, once the run has started."""
        return None if self._clock is None else self._clock.epoch_ns

    def now_ns(self) -> int:
        """Simulated time; 0 before the run has started."""
        return 0 if self._clock is None else self._clock.now_ns()

    def close(self) -> None:
        """Close the control plane."""
        self.plane.close()

    def poll(self) -> None:
        """Handle all messages that have arrived; call often."""
        while (end := self._ends.try_recv()) is not None:
            if header_of(end) is not None:
                self._note_end(end)
        while (token := self._tokens.try_recv()) is not None:
            self._note_connection(token)
        self._note_lost()
        while (query := self._admissions.try_recv()) is not None:
            self._answer(query, self._admit)
        while (query := self._joins.try_recv()) is not None:
            self._answer(query, self._join)
        if self._clock is None and self._stopped is None and not self.missing():
            self._start()
        while (query := self._change_queries.try_recv()) is not None:
            self._answer_change(query)

    def stop(self, reason: str) -> None:
        """Stop all processes of the run, those at the start barrier too."""
        self._stopped = reason
        self.plane.request_stop(reason)
        for member in self._members.values():
            if member.query is not None:
                self.plane.refuse(member.query, reason)
                member.query = None

    def instances(self) -> dict[str, str]:
        """The roles of the processes that have joined, by instance."""
        return {member.instance: role for role, member in self._members.items()}

    def missing(self) -> tuple[str, ...]:
        """Before the start: the roles that are not at the start barrier."""
        return tuple(role for role in ROLES if role not in self._members)

    def failures(self) -> Mapping[str, str]:
        """Roles of which the process is over before its work was done, and why."""
        failures = {role: member.failure() for role, member in self._members.items()}
        return {role: f"{role} {why}" for role, why in failures.items() if why is not None}

    def is_over(self, role: str) -> bool:
        """Whether the process of a role has joined, and has ended or is lost."""
        member = self._members.get(role)
        return member is not None and (member.ended is not None or member.is_lost)

    def has_ended(self, role: str) -> bool:
        """Whether the process of a role has reported its end; one that is lost has not."""
        return role in self._members and self._members[role].ended is not None

    def is_exiting(self, role: str) -> bool:
        """Whether a process reported its end a moment ago, so that it may not have exited yet."""
        return self.has_ended(role) and time.monotonic() - self._members[role].ended_s < _EXIT_GRACE_S

    def await_reported_failure(self, role: str) -> str | None:
        """Why a process ended early, by its own report; None without a report."""
        deadline_s = time.monotonic() + _REPORT_GRACE_S
        while role not in self._reported and time.monotonic() < deadline_s:
            time.sleep(0.01)
            self.poll()
        reason = self._reported.get(role)
        return None if reason == HORIZON else reason

    def progress(self) -> RunProgress | None:
        """The recorder's newest progress report; None without a new one."""
        with suppress(PeerError):  # not from the recorder
            if (payload := next_payload(self._progress)) is not None:
                return parse_message(RunProgress, payload)
        return None

    def _answer(self, query: zenoh.Query, respond: Callable[[str, zenoh.Query], None]) -> None:
        role = str(query.key_expr).rpartition("/")[2]
        if self._stopped is not None:
            self.plane.refuse(query, self._stopped)
            return
        try:
            respond(role, query)
        except PeerError as error:
            self.plane.refuse(query, f"cannot join: {error}")

    def _admit(self, role: str, query: zenoh.Query) -> None:
        """Admit a process to the run; raise PeerError if it cannot join.

        Several of a role may be admitted: the first at the start barrier joins, the others are refused there.
        """
        request = parse_message(AdmissionRequest, _payload(query))
        if role not in ROLES:
            raise PeerError("a run has no such process")
        if role in self._members:
            raise PeerError(f"another {role} is in this run already")
        clock = self._checked_clock(role, request.clock)
        lost_after_s = LAUNCHED_LOST_S if role in self._launched else LOST_AFTER_S
        self._admitted[role, request.instance] = _Member(role, request.instance, lost_after_s, clock)
        self.plane.answer(query, Admission())

    def _checked_clock(self, role: str, clock: ClockError | None) -> ClockError | None:
        """Return the clock of a process; raise PeerError if it may be off by more than is allowed."""
        if clock is None or self._own_clock is None or self._clock_settings is None:
            return None
        which = f"the clock of the {role}'s host"
        require_small_error(which, clock, self._clock_settings)
        self.notices.append(_clock_line(which, clock))
        return clock

    def _join(self, role: str, query: zenoh.Query) -> None:
        """Let a process wait at the start barrier; raise PeerError if it cannot join.

        It asks again when its connection was interrupted, and passes if the run has started.
        """
        request = parse_message(JoinRequest, _payload(query))
        member = self._admitted.get((role, request.instance))
        if member is None:
            raise PeerError("it was not admitted")
        if member.ended is not None:
            raise PeerError("it has ended")
        if self._members.get(role, member) is not member:
            raise PeerError(f"another {role} is in this run already")
        if (request.address is None) == (role in LOOP_ROLES):
            raise PeerError("a process of the loop needs an address, the recorder has none")
        if self._clock is not None and request.address != member.address:
            raise PeerError("its address must not change during the run")
        member.address, member.query = request.address, query
        member.vanished_s, member.is_lost = None, False
        self._members[role] = member
        if self._clock is not None:
            self._let_pass(member, self._clock.epoch_ns)

    def _start(self) -> None:
        """Open the start barrier."""
        is_quick = {*self._launched} == {*ROLES} and os.getloadavg()[0] <= cores()
        delay_ns = _START_DELAY_NS if is_quick else _LONG_START_DELAY_NS
        self._clock = RunClock(time.monotonic_ns() + delay_ns, self._speed)
        self._realtime_offset_ns = realtime_offset_ns()
        for member in self._members.values():
            self._let_pass(member, self._clock.epoch_ns)

    def _let_pass(self, member: _Member, epoch_ns: int) -> None:
        """Answer a join request with the start of the run."""
        members = [self._members[role] for role in LOOP_ROLES]
        query, member.query = member.query, None
        assert query is not None
        start = RunStart(
            epoch_ns=epoch_ns,
            epoch_realtime_ns=epoch_ns + self._realtime_offset_ns,
            clocks=self._clocks(),
            addresses={member.role: member.address for member in members if member.address is not None},
            changes=self._changes.announced,
        )
        self.plane.answer(query, start)

    def _clocks(self) -> dict[str, ClockError]:
        """The clocks of the processes of the loop, if there are several."""
        if self._own_clock is None or all(self._members[role].clock is None for role in LOOP_ROLES):
            return {}
        return {role: self._members[role].clock or self._own_clock for role in LOOP_ROLES}

    def _answer_change(self, query: zenoh.Query) -> None:
        obstacle = "the run has not started" if self._clock is None else None
        if self._stopped is not None:
            obstacle = f"the run is stopping: {self._stopped}"
        try:
            answer = self._changes.answer(_payload(query), self.now_ns, obstacle)
        except (CallerError, PeerError) as error:
            self.plane.refuse(query, str(error))
        else:
            self.plane.answer(query, answer)

    def _note_connection(self, token: zenoh.Sample) -> None:
        """Note that a process lost its connection, or has it again."""
        member = self._admitted.get(_sender(token.key_expr))
        if member is None:
            return
        member.vanished_s, member.is_lost = None, False
        if token.kind == zenoh.SampleKind.DELETE:
            member.vanished_s = time.monotonic()
            self._leave_barrier(member)

    def _note_lost(self) -> None:
        """Note which processes are lost.

        A process whose connection broke may have reached the end, and have written its report to disk.
        While this process was stopped, no connection could come back.
        """
        last_s, self._polled_s = self._polled_s, time.monotonic()
        missing = [member for member in self._admitted.values() if member.is_missing()]
        if self._polled_s - last_s > _OWN_STOP_S:
            for member in missing:
                assert member.vanished_s is not None
                member.vanished_s += self._polled_s - last_s
        if missing and self._polled_s >= self._next_look_s:
            self._next_look_s = self._polled_s + _LOOK_S
            for report in kept_reports(self._run_dir):
                self._end(report["process"], report.get("instance", ""), report["ended"])
        for member in self._admitted.values():
            member.is_lost = member.is_missing(member.lost_after_s)

    def _note_end(self, end: zenoh.Sample) -> None:
        """Note why a process ended, by its own report."""
        reason = end.payload.to_bytes().decode(errors="replace")
        role, instance = _sender(end.key_expr)
        self._reported[role] = reason
        self._end(role, instance, reason)

    def _end(self, role: str, instance: str, reason: str) -> None:
        if (member := self._admitted.get((role, instance))) is not None and member.ended is None:
            member.ended, member.ended_s = reason, time.monotonic()
            self._leave_barrier(member)

    def _leave_barrier(self, member: _Member) -> None:
        """Before the start: let another process, or the same one again, have the place of this one."""
        if self._clock is None and self._members.get(member.role) is member:
            del self._members[member.role]
            if member.query is not None:
                self.plane.dismiss(member.query)
                member.query = None


def _clock_line(which: str, clock: ClockError) -> str:
    """Return how far a clock may be off, and whether this was measured."""
    stated = f", as {STATED} states: there is no chrony" if clock.source == STATED else ""
    return f"{which} may be off by at most {clock.error_ns / 1000:g} µs{stated}"


def _sender(key_expr: object) -> tuple[str, str]:
    """Role and instance, the last two words of a key."""
    role, instance = str(key_expr).split("/")[-2:]
    return role, instance


def _payload(query: zenoh.Query) -> bytes:
    return b"" if query.payload is None else query.payload.to_bytes()
