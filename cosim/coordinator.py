"""The coordinator: admits the processes to a run, starts them together, and names who dies."""

import time
from collections.abc import Iterable
from typing import Any

import zenoh
from zenoh.handlers import FifoChannel, RingChannel

from noack.errors import PeerError
from noack.io.messages import Hello, Progress, heard
from noack.io.plane import Plane
from noack.io.ticket import Ticket
from noack.topology import COORDINATOR, LOOP_ROLES, ROLES

_START_DELAY_NS = 150_000_000
"""From the last arrival to the common epoch: time for everyone to hear of it."""

_LEAVE_GRACE_S = 0.3
"""A process says that it leaves; its word may come a little after its liveliness token vanishes."""


class Coordinator:
    """Start barrier, liveliness and stop of one run.

    Args:
        ticket: the run's ticket; its endpoint is listened on.

    Raises:
        PeerError: the endpoint cannot be listened on.
    """

    def __init__(self, ticket: Ticket) -> None:
        self.plane = Plane(ticket.run_id, COORDINATOR, ticket.endpoint, listen=True)
        session, key = self.plane.session, self.plane.key
        self._joins = session.declare_queryable(key("join", "*"), FifoChannel(64))
        self._lives = session.liveliness().declare_subscriber(key("alive", "*"), RingChannel(256))
        self._leaves = session.declare_subscriber(key("left", "*"), RingChannel(256))
        self._progress = session.declare_subscriber(key("progress"), RingChannel(1))
        self._waiting: dict[str, tuple[zenoh.Query, dict[str, Any]]] = {}
        self._vanished_s: dict[str, float] = {}
        self._stopped: str | None = None
        self.left: dict[str, str] = {}
        """Why each process that has left did so."""
        self.epoch_ns: int | None = None
        """Monotonic clock reading at simulated time 0, once the run has started."""

    def close(self) -> None:
        """Leave the control plane."""
        self.plane.close()

    def poll(self) -> None:
        """Handle whatever has arrived; call often."""
        while (query := self._joins.try_recv()) is not None:
            role = _role(query.key_expr)
            if self._stopped is not None:
                self.plane.refuse(query, self._stopped)
                continue
            if role not in ROLES or self.epoch_ns is not None:
                self.plane.refuse(query, f"{role} cannot join: the run has begun without it")
                continue
            try:
                self._waiting[role] = (query, _hello(role, query))
            except PeerError as error:
                self.plane.refuse(query, f"{role} cannot join: {error}")
        while (leave := self._leaves.try_recv()) is not None:
            reason = leave.payload.to_bytes().decode(errors="replace")
            self.left[_role(leave.key_expr)] = reason
        while (life := self._lives.try_recv()) is not None:
            role = _role(life.key_expr)
            if life.kind == zenoh.SampleKind.DELETE:
                self._vanished_s.setdefault(role, time.monotonic())
            else:
                self._vanished_s.pop(role, None)
        if self.epoch_ns is None and self._stopped is None and not self.missing():
            self._start()

    def stop(self, reason: str) -> None:
        """End the run for everyone, also for those who are still on their way to the barrier."""
        self._stopped = reason
        self.plane.request_stop(reason)
        if self.epoch_ns is None:
            for query, _ in self._waiting.values():
                self.plane.refuse(query, reason)

    def missing(self) -> tuple[str, ...]:
        """Roles that have not arrived at the start barrier."""
        return tuple(role for role in ROLES if role not in self._waiting)

    def vanished(self) -> Iterable[str]:
        """Roles that disappeared without a word."""
        now_s = time.monotonic()
        for role, since_s in self._vanished_s.items():
            if role in ROLES and role not in self.left and now_s - since_s > _LEAVE_GRACE_S:
                yield role

    def progress(self) -> dict[str, Any] | None:
        """The recorder's newest account of the run, if there is a new one."""
        sample = self._progress.try_recv()
        if sample is None:
            return None
        try:
            return heard(Progress, sample.payload.to_bytes())
        except PeerError:  # whoever says so is not the recorder
            return None

    def _start(self) -> None:
        self.epoch_ns = time.monotonic_ns() + _START_DELAY_NS
        start = {
            "epoch_ns": self.epoch_ns,
            "addresses": {role: self._waiting[role][1]["address"] for role in LOOP_ROLES},
        }
        for query, _ in self._waiting.values():
            self.plane.answer(query, start)


def _hello(role: str, query: zenoh.Query) -> dict[str, Any]:
    hello = heard(Hello, b"" if query.payload is None else query.payload.to_bytes())
    if (hello["address"] is None) == (role in LOOP_ROLES):
        raise PeerError("no address, or one too many")
    return hello


def _role(key_expr: object) -> str:
    return str(key_expr).rpartition("/")[2]
