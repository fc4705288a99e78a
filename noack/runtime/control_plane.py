"""The control plane: start barrier, liveliness, stop, telemetry, all on zenoh.

A star over TCP on loopback: the coordinator listens, everyone else connects, with a secret that
only follows from the run's key. The loop's data never travels here, and nothing in the loop waits
for it.
"""

import hashlib
import json
import secrets
import time
from collections.abc import Callable
from typing import Self

import zenoh
from zenoh import CongestionControl, Priority
from zenoh.handlers import FifoChannel, RingChannel

from noack.config.scenario import MOST_CHANGES
from noack.core.errors import NoAnswerError, PeerError
from noack.protocol.topology import COORDINATOR
from noack.runtime.join_ticket import Ticket
from noack.runtime.zenoh_session import SessionSecret, cause_of, open_session

_ASK_AGAIN_S = 5.0
_POLL_S = 0.01
"""Twenty runs that wait at their start are a hundred processes that look so often."""


def secret_of(ticket: Ticket) -> SessionSecret:
    """Return the secret of a run's plane; the run's key cannot be found from it."""
    keyed = hashlib.blake2b(b"the control plane's password", key=ticket.key, digest_size=32)
    return SessionSecret(f"{ticket.run_id:016x}", keyed.hexdigest())


class ControlPlane:
    """One process's connection to the control plane of a run.

    Args:
        ticket: admission to the run; every key lies below ``noack/RUN``.
        role: this process.
        listen: this is the coordinator.

    Raises:
        NoAnswerError: the coordinator cannot be reached, or the endpoint cannot be listened on.
    """

    def __init__(self, ticket: Ticket, role: str, *, listen: bool = False) -> None:
        self._prefix = f"noack/{ticket.run_id:016x}"
        self.role = role
        self.instance = secrets.token_hex(8)
        endpoint = ticket.endpoint
        try:
            self.session = open_session(endpoint, secret_of(ticket), listen=listen)
        except zenoh.ZError as error:
            verb = "listen on" if listen else "reach the run's coordinator at"
            raise NoAnswerError(f"cannot {verb} {endpoint}: {cause_of(error)}") from None
        self._token = self.session.liveliness().declare_token(
            self.key("alive", role, self.instance)
        )
        self._stops = self.session.declare_subscriber(self.key("stop"), RingChannel(8))
        self._stop_reason: str | None = None
        self._coordinator = self.session.liveliness().declare_subscriber(
            self.key("alive", COORDINATOR, "*"), RingChannel(8), history=True
        )
        self._coordinator_gone_s: float | None = None
        # As many as there can be: none is ever pushed out.
        self._changes = self.session.declare_subscriber(
            self.key("change"), RingChannel(MOST_CHANGES)
        )
        self._kept = self.session.declare_subscriber(self.key("kept", role), RingChannel(1))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the plane; the others see this process's token vanish."""
        if not self.session.is_closed():
            self.session.close()  # type: ignore[no-untyped-call]

    def key(self, *parts: str) -> str:
        """Key expression below this run."""
        return "/".join((self._prefix, *parts))

    def stop_requested(self) -> str | None:
        """The reason of a stop that the coordinator has asked for, or None."""
        if self._stop_reason is None:
            sample = self._stops.try_recv()
            if sample is not None:
                reason = sample.payload.to_bytes().decode(errors="replace")
                self._stop_reason = reason or "stopped"
        return self._stop_reason

    def coordinator_gone(self, *, for_s: float = 0.0) -> bool:
        """Whether the coordinator was there and has disappeared.

        Args:
            for_s: for how long it must have been away. On a busy machine a connection may end
                because one of its ends was not run; it comes back by itself.
        """
        while (life := self._coordinator.try_recv()) is not None:
            gone = life.kind == zenoh.SampleKind.DELETE
            self._coordinator_gone_s = time.monotonic() if gone else None
        since_s = self._coordinator_gone_s
        return since_s is not None and time.monotonic() - since_s >= for_s

    def request_stop(self, reason: str) -> None:
        """Ask every process of the run to end."""
        self.session.put(self.key("stop"), reason, priority=Priority.REAL_TIME)

    def acknowledge_rows(self, role: str, content: object) -> None:
        """Tell a process what of it is on disk."""
        self.session.put(
            self.key("kept", role),
            json.dumps(content),
            congestion_control=CongestionControl.DROP,
        )

    def kept(self) -> bytes | None:
        """The recorder's newest word on what it has of this process, if there is a new one."""
        sample = self._kept.try_recv()
        return None if sample is None else sample.payload.to_bytes()

    def announce(self, content: object) -> None:
        """Tell every process of the run of a change of settings."""
        self.session.put(self.key("change"), json.dumps(content), priority=Priority.REAL_TIME)

    def announced(self) -> bytes | None:
        """The next change that was announced; None if there is none."""
        sample = self._changes.try_recv()
        return None if sample is None else sample.payload.to_bytes()

    def leave(self, reason: str) -> None:
        """Tell the coordinator that this process ends, and why; without it, it counts as dead."""
        self.session.put(
            self.key("left", self.role, self.instance), reason, priority=Priority.REAL_TIME
        )

    def publish_telemetry(self, table: str, header: bytes, payload: bytes) -> None:
        """Publish a batch; it never blocks, and is dropped when the recorder does not keep up."""
        self.session.put(
            self.key("telemetry", self.role, table),
            payload,
            attachment=header,
            congestion_control=CongestionControl.DROP,
            priority=Priority.BACKGROUND,
        )

    def publish_telemetry_blocking(self, table: str, header: bytes, payload: bytes) -> None:
        """Publish a batch outside the loop, waiting for room."""
        self.session.put(
            self.key("telemetry", self.role, table),
            payload,
            attachment=header,
            congestion_control=CongestionControl.BLOCK,
        )

    @staticmethod
    def answer(query: zenoh.Query, content: object) -> None:
        """Answer a request."""
        query.reply(query.key_expr, json.dumps(content))
        query.drop()  # type: ignore[no-untyped-call]

    @staticmethod
    def refuse(query: zenoh.Query, why: str) -> None:
        """Answer a request with an error."""
        query.reply_err(why)
        query.drop()  # type: ignore[no-untyped-call]

    @staticmethod
    def dismiss(query: zenoh.Query) -> None:
        """Leave a request without an answer; whoever still waits for one asks again."""
        query.drop()  # type: ignore[no-untyped-call]

    def request(
        self,
        what: str,
        content: object,
        *,
        timeout_s: float,
        give_up: Callable[[], bool] = lambda: False,
    ) -> bytes:
        """Ask the queryable ``what/ROLE`` and return its answer.

        An answer may take as long as ``timeout_s``. It is asked for again when the queryable does
        not exist yet, and every five seconds: when a connection was interrupted, question or answer
        may be lost. So who answers must take a question twice.

        Raises:
            NoAnswerError: no answer came.
            PeerError: the answer was an error.
        """
        deadline_s = time.monotonic() + timeout_s
        payload = json.dumps(content)
        while (left_s := deadline_s - time.monotonic()) > 0 and not give_up():
            wait_s = min(left_s, _ASK_AGAIN_S)
            replies = self.session.get(
                self.key(what, self.role),
                FifoChannel(4),
                payload=payload,
                timeout=wait_s + _ASK_AGAIN_S,  # zenoh's own would come as an error's answer
            )
            again_s = time.monotonic() + wait_s
            while not give_up() and time.monotonic() < again_s:
                try:
                    reply = replies.try_recv()
                except zenoh.ZError:  # the query has ended without an answer
                    break
                if reply is None:
                    time.sleep(_POLL_S)
                    continue
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
                if reply.err is not None:
                    raise PeerError(reply.err.payload.to_bytes().decode(errors="replace"))
            time.sleep(0.02)
        raise NoAnswerError(f"no answer to {what!r} within {timeout_s:g} s")
