"""The coordinator: admits the processes to a run, starts them together, and names who dies.

A process of the loop that has died may be followed by another, which takes its place: it receives
where the one before it did, and numbers on where nobody can have numbered before.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from noack.config.parameter_changes import (
    ChangeSchedule,
    ParameterChange,
    current_parameters,
    scheduled,
)
from noack.config.scenario import MOST_CHANGES
from noack.core.clock import NS_PER_S, RunClock
from noack.core.errors import CallerError, PeerError
from noack.protocol.topology import COORDINATOR, LOOP_ROLES, ROLES
from noack.runtime.control_messages import (
    AdmissionRequest,
    ChangeRequest,
    JoinRequest,
    RunProgress,
    parse_message,
)
from noack.runtime.control_plane import ControlPlane
from noack.runtime.join_ticket import Ticket
from noack.runtime.process_life import HORIZON

_START_DELAY_NS = 150_000_000
"""From the last arrival to the common epoch: time for everyone to hear of it."""
_RESTART_DELAY_S = 0.3
"""Wall time that a process takes from its admission to its loop."""

_CHANGE_DELAY_S = 0.2
"""Wall time from the announcement of a change to its effect: everyone looks every 0.05 s."""
_MILLISECOND_NS = 1_000_000

_LEAVE_GRACE_S = 0.3
"""A process says that it leaves; its word may come a little after its liveliness token vanishes."""

_EXIT_GRACE_S = 5.0
"""By then a process has ended that says that it ends."""


@dataclass
class _Member:
    """A process that was admitted."""

    instance: str
    generation: int
    address: tuple[str, int] | None = None
    query: zenoh.Query | None = None
    """What it waits at the barrier with."""
    present: bool = False
    """Whether it has passed the barrier."""
    vanished_s: float | None = None
    left: str | None = None
    left_s: float = 0.0
    """Reading of the monotonic clock when it said so."""

    def gone(self) -> str | None:
        """Why it is gone; None if it is not, as far as anybody knows."""
        if self.left is not None:
            return None if self.left == HORIZON else f"ended early: {self.left}"
        if self.vanished_s is None or time.monotonic() - self.vanished_s <= _LEAVE_GRACE_S:
            return None
        return "stopped answering"


class Coordinator:
    """Start barrier, liveliness and stop of one run.

    Args:
        ticket: the run's ticket; its endpoint is listened on.

    Raises:
        PeerError: the endpoint cannot be listened on.
    """

    def __init__(self, ticket: Ticket) -> None:
        self.plane = ControlPlane(ticket, COORDINATOR, listen=True)
        session, key = self.plane.session, self.plane.key
        self._knocks = session.declare_queryable(key("admit", "*"), FifoChannel(64))
        self._joins = session.declare_queryable(key("join", "*"), FifoChannel(64))
        self._lives = session.liveliness().declare_subscriber(
            key("alive", "*", "*"), RingChannel(256)
        )
        self._leaves = session.declare_subscriber(key("left", "*", "*"), RingChannel(256))
        self._progress = session.declare_subscriber(key("progress"), RingChannel(1))
        self._questions = session.declare_queryable(key("runtime_parameters"), FifoChannel(64))
        self._scenario, self._run_dir = ticket.scenario, ticket.run_dir
        self._schedule = ChangeSchedule(ticket.scenario)
        self._changes: list[dict[str, Any]] = []
        for change in scheduled(ticket.scenario):
            self._take_change(change, 0, "the scenario says so")
        self._speed = ticket.scenario.speed
        self._clock: RunClock | None = None
        self._candidates: dict[tuple[str, str], _Member] = {}
        self._members: dict[str, _Member] = {}
        self._before: dict[str, str] = {}
        self._last_words: dict[str, str] = {}
        self._stopped: str | None = None

    @property
    def epoch_ns(self) -> int | None:
        """Monotonic clock reading at simulated time 0, once the run has started."""
        return None if self._clock is None else self._clock.epoch_ns

    def now_ns(self) -> int:
        """Simulated time; 0 before the run has started."""
        return 0 if self._clock is None else self._clock.now_ns()

    def close(self) -> None:
        """Leave the control plane."""
        self.plane.close()

    def poll(self) -> None:
        """Handle whatever has arrived; call often."""
        while (leave := self._leaves.try_recv()) is not None:
            reason = leave.payload.to_bytes().decode(errors="replace")
            self._last_words[_whose(leave.key_expr)[0]] = reason
            if (member := self._member(leave.key_expr)) is not None:
                member.left, member.left_s = reason, time.monotonic()
        while (life := self._lives.try_recv()) is not None:
            if (member := self._member(life.key_expr)) is not None:
                gone = life.kind == zenoh.SampleKind.DELETE
                member.vanished_s = time.monotonic() if gone else None
        if self._clock is None:
            for role in list(self._members):
                if self.finished(role):  # another may come in its stead
                    member = self._members.pop(role)
                    if member.left is None:  # or itself, if it was only held up
                        self._candidates[role, member.instance] = _Member(member.instance, 0)
                    if member.query is not None:
                        self.plane.dismiss(member.query)
        while (query := self._knocks.try_recv()) is not None:
            self._answer(query, self._admit)
        while (query := self._joins.try_recv()) is not None:
            self._answer(query, self._join)
        while (query := self._questions.try_recv()) is not None:
            try:
                self.plane.answer(
                    query, self._answer_to(parse_message(ChangeRequest, _payload(query)))
                )
            except (CallerError, PeerError) as error:
                self.plane.refuse(query, str(error))
        if self._clock is None and self._stopped is None and not self.missing():
            self._start()

    def stop(self, reason: str) -> None:
        """End the run for everyone, also for those who are still on their way to the barrier."""
        self._stopped = reason
        self.plane.request_stop(reason)
        for member in self._members.values():
            if member.query is not None:
                self.plane.refuse(member.query, reason)
                member.query = None

    def missing(self) -> tuple[str, ...]:
        """Roles that have not arrived at the start barrier."""
        return tuple(
            role
            for role in ROLES
            if (member := self._members.get(role)) is None or member.query is None
        )

    def gone(self) -> Mapping[str, str]:
        """Roles whose process is gone before its work was done, and why."""
        found = {role: member.gone() for role, member in self._members.items()}
        return {role: f"{role} {why}" for role, why in found.items() if why is not None}

    def finished(self, role: str) -> bool:
        """Whether the process of a role has done its work, or is gone."""
        member = self._members.get(role)
        return member is not None and (member.left is not None or member.gone() is not None)

    def is_leaving(self, role: str) -> bool:
        """Whether a process said a moment ago that it ends, so that it may not have ended yet."""
        member = self._members.get(role)
        if member is None or member.left is None:
            return False
        return time.monotonic() - member.left_s < _EXIT_GRACE_S

    def last_words(self, role: str) -> str | None:
        """Why a process that has ended did so, as it said itself; None if it said nothing."""
        deadline_s = time.monotonic() + _LEAVE_GRACE_S
        while role not in self._last_words and time.monotonic() < deadline_s:
            time.sleep(0.01)
            self.poll()
        words = self._last_words.get(role)
        return None if words == HORIZON else words

    def generation(self, role: str) -> int | None:
        """Number of the process of a role that is in the loop now; None while none is."""
        member = self._members.get(role)
        here = member is not None and member.present and not self.finished(role)
        return member.generation if member is not None and here else None

    def expect(self, role: str, after: str, *, dead: bool) -> None:
        """Let another process take the place of one that is gone.

        Args:
            role: whose.
            after: what became of the one before it.
            dead: it cannot come back by itself.
        """
        self._before[role] = after
        self._last_words.pop(role, None)
        if dead:
            self._members[role].left = after

    def progress(self) -> dict[str, Any] | None:
        """The recorder's newest account of the run, if there is a new one."""
        sample = self._progress.try_recv()
        if sample is None:
            return None
        try:
            return parse_message(RunProgress, sample.payload.to_bytes())
        except PeerError:  # whoever says so is not the recorder
            return None

    def _answer_to(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Change what is asked for, and say how the settings are.

        Raises:
            CallerError: that cannot be changed, or not now.
        """
        settings, from_s = asked.get("settings", {}), None
        now_ns = self.now_ns()
        if settings:
            if self._clock is None:
                raise CallerError("the run has not begun")
            if self._stopped is not None:
                raise CallerError(f"the run ends: {self._stopped}")
            if len(self._changes) >= MOST_CHANGES:
                raise CallerError(f"a run can be changed {MOST_CHANGES} times, and this one was")
            delay_ns = int(_CHANGE_DELAY_S * NS_PER_S * self._speed)
            t_ns = -(-max(now_ns + delay_ns, 0) // _MILLISECOND_NS) * _MILLISECOND_NS
            if t_ns >= self._scenario.timing.horizon_ns:
                raise CallerError(f"the run ends at {self._scenario.horizon_s:g} s, before that")
            change = ParameterChange(len(self._changes), t_ns, settings)
            said_at = datetime.now(UTC).isoformat(timespec="milliseconds")
            self.plane.announce(self._take_change(change, now_ns, said_at))
            from_s = t_ns / NS_PER_S
        return {
            "name": self._scenario.name,
            "run_dir": self._run_dir,
            "t_s": now_ns / NS_PER_S,
            "from_s": from_s,
            "runtime_parameters": current_parameters(self._schedule.last),
        }

    def _take_change(self, change: ParameterChange, said_ns: int, said_at: str) -> dict[str, Any]:
        """Keep a change, as everybody is told of it.

        Raises:
            CallerError: it is none that the run could have.
        """
        self._schedule.announce("", change, 0, 0, -1)
        said = {
            "number": change.number,
            "t_ns": change.t_ns,
            "settings": dict(change.settings),
            "said_ns": said_ns,
            "said_at": said_at,
        }
        self._changes.append(said)
        return said

    def _member(self, key_expr: object) -> _Member | None:
        role, instance = _whose(key_expr)
        member = self._members.get(role)
        return member if member is not None and member.instance == instance else None

    def _answer(self, query: zenoh.Query, respond: Any) -> None:
        role = str(query.key_expr).rpartition("/")[2]
        if self._stopped is not None:
            self.plane.refuse(query, self._stopped)
            return
        try:
            respond(role, query)
        except PeerError as error:
            self.plane.refuse(query, f"cannot join: {error}")

    def _admit(self, role: str, query: zenoh.Query) -> None:
        """Say who a process is in the run.

        Raises:
            PeerError: it cannot join.
        """
        instance = parse_message(AdmissionRequest, _payload(query))["instance"]
        before = self._members.get(role)
        if role not in ROLES:
            raise PeerError("a run has no such process")
        if before is not None and not self.finished(role):
            raise PeerError(f"another {role} is in this run already")
        if self._clock is None:
            self._candidates[role, instance] = _Member(instance, 0)
            admission: dict[str, Any] = {
                "generation": 0, "admitted_ns": 0, "from_ns": 0, "address": None, "after": None,
            }  # fmt: skip
        else:
            if before is None or role not in self._before:
                raise PeerError("the run has begun without it")
            now_ns = self._clock.now_ns()
            delay_ns = int(_RESTART_DELAY_S * NS_PER_S * self._speed)
            candidate = _Member(instance, before.generation + 1, before.address)
            self._candidates[role, instance] = candidate
            admission = {
                "generation": candidate.generation,
                "admitted_ns": now_ns,
                "from_ns": now_ns + delay_ns,
                "address": before.address,
                "after": self._before[role],
            }
        self.plane.answer(query, admission)

    def _join(self, role: str, query: zenoh.Query) -> None:
        """Take a process to the barrier, or, if the run has begun, past it.

        Raises:
            PeerError: it cannot join.
        """
        hello = parse_message(JoinRequest, _payload(query))
        member = self._entrant(role, hello["instance"])
        if (hello["address"] is None) == (role in LOOP_ROLES):
            raise PeerError("no address, or one too many")
        if self._clock is None:
            member.address, member.query = hello["address"], query
        elif hello["address"] != member.address:
            raise PeerError("it does not receive where it is sent to")
        self._candidates.pop((role, member.instance), None)
        self._members[role] = member
        if self._clock is not None:
            member.present = True
            self._before.pop(role, None)
            self._begin(query)

    def _entrant(self, role: str, instance: str) -> _Member:
        """Return who is at the barrier; who is there already may ask again."""
        before, candidate = self._members.get(role), self._candidates.get((role, instance))
        if before is not None and before.instance == instance:
            return before
        if before is not None and not self.finished(role):
            raise PeerError(f"another {role} is in this run already")
        late = before is not None and candidate and candidate.generation <= before.generation
        if candidate is None or (late and self._clock is not None):
            raise PeerError("it was not admitted")
        return candidate

    def _start(self) -> None:
        self._clock = RunClock(time.monotonic_ns() + _START_DELAY_NS, self._speed)
        for member in self._members.values():
            assert member.query is not None
            self._begin(member.query)
            member.query, member.present = None, True

    def _begin(self, query: zenoh.Query) -> None:
        addresses = {role: self._members[role].address for role in LOOP_ROLES}
        self.plane.answer(
            query, {"epoch_ns": self.epoch_ns, "addresses": addresses, "changes": self._changes}
        )


def _whose(key_expr: object) -> tuple[str, str]:
    """Role and instance, the last two words of a key."""
    role, instance = str(key_expr).split("/")[-2:]
    return role, instance


def _payload(query: zenoh.Query) -> bytes:
    return b"" if query.payload is None else query.payload.to_bytes()
