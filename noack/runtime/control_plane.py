"""The control plane of a run: start barrier, liveliness, stop, telemetry, all on zenoh.

Loop data never travels here, and the loop never waits for it. The coordinator listens on a Unix
socket in the user's runtime directory, which is closed to other users; all other processes connect
to it. From another host they connect by TLS, with certificates of the run at both ends
(``connections/credentials.py``).
"""

import secrets
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Self

import zenoh
from zenoh import CongestionControl, Priority
from zenoh.handlers import FifoChannel, RingChannel

from netem.core.errors import NoAnswerError, PeerError
from netem.impairments.target_loss import store_probabilities
from noack.protocol.roles import COORDINATOR
from noack.runtime.active_runs import RUNS, run_name
from noack.runtime.connections.credentials import access_control, no_connection, tls_settings
from noack.runtime.connections.zenoh_session import (
    TlsEndpoint,
    cause_of,
    first_reply,
    label,
    next_payload,
    open_remote_session,
    open_session,
)
from noack.runtime.control_messages import ChangeAnnouncement, message_json, parse_message
from noack.runtime.run_descriptor import RunAccess
from noack.runtime.spool import writer_of
from noack.scenario.scenario_tables import MOST_CHANGES

_REQUEST_AGAIN_S = 5.0
"""After this time without an answer a request is sent again."""
_POLL_S = 0.01
"""Twenty runs that wait at the start barrier are a hundred processes that poll at this rate."""


class ControlPlane:
    """The connection of a process (``role``) to the control plane of a run.

    Every key lies below ``noack/RUN``. With ``listen`` the process is the coordinator. Raise
    NoAnswerError if the coordinator cannot be reached, or the socket cannot be listened on;
    CallerError if other users have access to the user's runtime directory.
    """

    def __init__(self, access: RunAccess, role: str, *, listen: bool = False) -> None:
        self._prefix = f"noack/{run_name(access.run_id)}"
        self.role = role
        self.secret = secrets.token_hex(32)
        self.instance = writer_of(self.secret)
        remote = None
        if (address := access.remote) is not None:
            rules = access_control(self._prefix) if listen else None
            remote = TlsEndpoint(address, tls_settings(access.credentials, listen=listen), rules)
        try:
            self.session = (
                open_session(RUNS, run_name(access.run_id), listen=listen, remote=remote)
                if listen or remote is None
                else open_remote_session(remote)
            )
        except zenoh.ZError as error:
            if address is not None and not listen:
                raise no_connection(address) from None
            task = "start the control plane" if listen else "reach the run's coordinator"
            raise NoAnswerError(f"cannot {task}: {cause_of(error)}") from None
        session, key = self.session, self.key
        self._token = session.liveliness().declare_token(key("alive", role, self.instance))
        self._coordinator = session.liveliness().declare_subscriber(
            key("alive", COORDINATOR, "*"), RingChannel(8), history=True
        )
        self._coordinator_gone_s: float | None = None
        self._stops = session.declare_subscriber(key("stop"), RingChannel(8))
        self._stop_reason: str | None = None
        # Room for all possible changes: none is ever pushed out.
        self._changes = session.declare_subscriber(key("change"), RingChannel(MOST_CHANGES))
        self._dones = session.declare_subscriber(key("done", "*"), RingChannel(8))
        self._roles_done: set[str] = set()
        self._persisted = session.declare_subscriber(key("persisted", role), RingChannel(1))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the session; this process's liveliness token vanishes."""
        if not self.session.is_closed():
            self.session.close()  # type: ignore[no-untyped-call]

    def key(self, *parts: str) -> str:
        """Key expression below this run."""
        return "/".join((self._prefix, *parts))

    def stop_requested(self) -> str | None:
        """The reason of the coordinator's stop request; None without a request."""
        if self._stop_reason is None and (reason := next_payload(self._stops)) is not None:
            self._stop_reason = reason.decode(errors="replace") or "stopped"
        return self._stop_reason

    def coordinator_gone(self, *, for_s: float = 0.0) -> bool:
        """Whether the coordinator's liveliness token has vanished, for at least ``for_s`` seconds.

        On a busy machine a connection may break because one end got no CPU time; it comes back.
        """
        while (life := self._coordinator.try_recv()) is not None:
            has_vanished = life.kind == zenoh.SampleKind.DELETE
            self._coordinator_gone_s = time.monotonic() if has_vanished else None
        since_s = self._coordinator_gone_s
        return since_s is not None and time.monotonic() - since_s >= for_s

    def publish(
        self,
        *parts: str,
        content: str | bytes,
        header: bytes = b"",
        priority: Priority | None = None,
        congestion: CongestionControl | None = None,
    ) -> None:
        """Send a message to the subscribers of a key."""
        key = self.key(*parts)
        sent_as = label(key, header)
        self.session.put(key, content, attachment=sent_as, priority=priority, congestion_control=congestion)

    def request_stop(self, reason: str) -> None:
        """Ask all processes of the run to stop."""
        self.publish("stop", content=reason, priority=Priority.REAL_TIME)

    def acknowledge_rows(self, role: str, content: object) -> None:
        """Confirm to a process which of its rows are on disk."""
        drop = CongestionControl.DROP
        self.publish("persisted", role, content=message_json(content), congestion=drop)

    def next_persisted_ack(self) -> bytes | None:
        """The recorder's newest confirmation of rows of this process; None without a new one."""
        return next_payload(self._persisted)

    def announce_change(self, content: object) -> None:
        """Announce a change of runtime parameters to all processes."""
        self.publish("change", content=message_json(content), priority=Priority.REAL_TIME)

    def next_change(self) -> bytes | None:
        """The next announced change; None if there is none."""
        return next_payload(self._changes)

    def announce_done(self) -> None:
        """Tell the other processes that this one has done its last step."""
        self._roles_done.add(self.role)
        self.publish("done", self.role, content=self.role, priority=Priority.REAL_TIME)

    def roles_done(self) -> set[str]:
        """The roles whose process has announced that it is done."""
        while (role := next_payload(self._dones)) is not None:
            self._roles_done.add(role.decode(errors="replace"))
        return self._roles_done

    def report_end(self, reason: str) -> None:
        """Report to the coordinator why this process ends; without a report it counts as dead."""
        self.publish("ended", self.role, self.instance, content=reason, priority=Priority.REAL_TIME)

    def publish_telemetry(self, table: str, header: bytes, payload: bytes) -> None:
        """Publish a batch without blocking; it is dropped if the recorder cannot keep up."""
        key, low = ("telemetry", self.role, table), Priority.BACKGROUND
        drop = CongestionControl.DROP
        self.publish(*key, content=payload, header=header, priority=low, congestion=drop)

    def publish_telemetry_blocking(self, table: str, header: bytes, payload: bytes) -> None:
        """Publish a batch outside the loop; block until there is room."""
        key, block = ("telemetry", self.role, table), CongestionControl.BLOCK
        self.publish(*key, content=payload, header=header, congestion=block)

    @staticmethod
    def answer(query: zenoh.Query, content: object) -> None:
        """Answer a request."""
        query.reply(query.key_expr, message_json(content))
        query.drop()  # type: ignore[no-untyped-call]

    @staticmethod
    def refuse(query: zenoh.Query, reason: str) -> None:
        """Answer a request with an error."""
        query.reply_err(reason)
        query.drop()  # type: ignore[no-untyped-call]

    @staticmethod
    def dismiss(query: zenoh.Query) -> None:
        """Drop a request unanswered; a process that still waits sends it again."""
        query.drop()  # type: ignore[no-untyped-call]

    def request(
        self,
        queryable: str,
        content: object,
        *,
        timeout_s: float,
        give_up: Callable[[], bool] = lambda: False,
    ) -> bytes:
        """Send a request (as JSON) to ``queryable/ROLE`` and return the answer.

        The request is sent again while the queryable does not exist, and every five seconds: an
        interrupted connection may lose request or answer. So the answering side must accept a
        request twice. The wait ends early when ``give_up()`` is true. Raise NoAnswerError if no
        answer came, PeerError if the answer was an error.
        """
        deadline_s = time.monotonic() + timeout_s
        payload = message_json(content)
        while (left_s := deadline_s - time.monotonic()) > 0 and not give_up():
            wait_s = min(left_s, _REQUEST_AGAIN_S)
            replies = self.session.get(
                self.key(queryable, self.role),
                FifoChannel(4),
                payload=payload,
                timeout=wait_s + _REQUEST_AGAIN_S,  # zenoh would report its own as an error answer
            )
            until_s = time.monotonic() + wait_s
            reply = first_reply(replies, until_s, poll_s=_POLL_S, give_up=give_up)
            if reply is not None and reply.ok is not None:
                return reply.ok.payload.to_bytes()
            if reply is not None and reply.err is not None:
                raise PeerError(reply.err.payload.to_bytes().decode(errors="replace"))
            time.sleep(0.02)
        raise NoAnswerError(f"the run did not answer the request {queryable!r} within {timeout_s:g} s")


class ParameterUpdates:
    """Announced changes that the process has not taken yet, each once and in order."""

    def __init__(self, plane: ControlPlane) -> None:
        self._plane = plane
        self._waiting: list[ChangeAnnouncement] = []
        self._next_number = 0

    def extend(self, announcements: Iterable[ChangeAnnouncement]) -> None:
        """Add the changes that were announced before this process joined."""
        self._waiting.extend(announcements)

    def take(self, at_most: int | None = None) -> list[ChangeAnnouncement]:
        """Return waiting changes, at most a number of them."""
        while (message := self._plane.next_change()) is not None:
            with suppress(PeerError):  # not from the coordinator
                self._waiting.append(parse_message(ChangeAnnouncement, message))
        updates: list[ChangeAnnouncement] = []
        while self._waiting and (at_most is None or len(updates) < at_most):
            announced = self._waiting.pop(0)
            store_probabilities(announced.target_losses)
            if announced.number >= self._next_number:  # a late process receives some twice
                self._next_number = announced.number + 1
                updates.append(announced)
        return updates
