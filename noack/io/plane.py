"""The control plane: start barrier, liveliness, stop, telemetry, all on zenoh.

A star over TCP on loopback: the coordinator listens, everyone else connects. The loop's data never
travels here, and nothing in the loop waits for it.
"""

import json
import time
from collections.abc import Callable, Mapping
from typing import Any, Self

import zenoh
from zenoh import CongestionControl, Priority
from zenoh.handlers import FifoChannel, RingChannel

from noack.errors import PeerError
from noack.topology import COORDINATOR

_LEASE_MS = 2000
_CONNECT_MS = 5000


def star_config(
    endpoint: str, *, listen: bool, more: Mapping[str, Any] | None = None
) -> zenoh.Config:
    """Return the configuration of a star's centre (``listen``), or of one who connects to it.

    Args:
        endpoint: where the centre listens, e.g. ``tcp/127.0.0.1:7447``.
        listen: this is the centre.
        more: further settings of zenoh by their keys.
    """
    config = zenoh.Config()
    side, other = ("listen", "connect") if listen else ("connect", "listen")
    settings: dict[str, Any] = {
        "mode": "router" if listen else "client",
        f"{side}/endpoints": [endpoint],
        f"{other}/endpoints": [],
        f"{side}/exit_on_failure": True,
        f"{side}/timeout_ms": _CONNECT_MS,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        # Its shared-memory path would take payloads of 3 KiB and more past the socket.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        # A batch that finds no room is dropped at once; the loop does not wait for it.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    }
    for key, value in (settings | dict(more or {})).items():
        config.insert_json5(key, json.dumps(value))
    return config


def cause_of(error: zenoh.ZError) -> str:
    """Return what went wrong, in zenoh's words."""
    # zenoh ends its messages with the place in its own source.
    return str(error).partition(" at /")[0]


class Plane:
    """One process's connection to the control plane of a run.

    Args:
        run_id: the run; every key lies below ``noack/RUN``.
        role: this process.
        endpoint: where the coordinator listens.
        listen: this is the coordinator.

    Raises:
        PeerError: the coordinator cannot be reached, or the endpoint cannot be listened on.
    """

    def __init__(self, run_id: int, role: str, endpoint: str, *, listen: bool = False) -> None:
        self._prefix = f"noack/{run_id:016x}"
        self.role = role
        try:
            self.session = zenoh.open(star_config(endpoint, listen=listen))
        except zenoh.ZError as error:
            verb = "listen on" if listen else "reach the run's coordinator at"
            raise PeerError(f"{role}: cannot {verb} {endpoint}: {cause_of(error)}") from None
        self._token = self.session.liveliness().declare_token(self.key("alive", role))
        self._stops = self.session.declare_subscriber(self.key("stop"), RingChannel(8))
        self._stop_reason: str | None = None
        self._coordinator = self.session.liveliness().declare_subscriber(
            self.key("alive", COORDINATOR), RingChannel(8), history=True
        )
        self._coordinator_gone = False

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

    def coordinator_gone(self) -> bool:
        """Whether the coordinator was there and has disappeared."""
        while (life := self._coordinator.try_recv()) is not None:
            self._coordinator_gone = life.kind == zenoh.SampleKind.DELETE
        return self._coordinator_gone

    def request_stop(self, reason: str) -> None:
        """Ask every process of the run to end."""
        self.session.put(self.key("stop"), reason, priority=Priority.REAL_TIME)

    def leave(self, reason: str) -> None:
        """Tell the coordinator that this process ends, and why; without it, it counts as dead."""
        self.session.put(self.key("left", self.role), reason, priority=Priority.REAL_TIME)

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

    def request(
        self,
        what: str,
        content: object,
        *,
        timeout_s: float,
        give_up: Callable[[], bool] = lambda: False,
    ) -> Any:
        """Ask the queryable ``what/ROLE`` and return its JSON answer.

        An answer may take as long as ``timeout_s``; a queryable that does not exist yet is asked
        again.

        Raises:
            PeerError: no answer came, or it was an error.
        """
        deadline_s = time.monotonic() + timeout_s
        payload = json.dumps(content)
        while (left_s := deadline_s - time.monotonic()) > 0 and not give_up():
            replies = self.session.get(
                self.key(what, self.role), FifoChannel(4), payload=payload, timeout=left_s
            )
            while not give_up() and time.monotonic() < deadline_s:
                try:
                    reply = replies.try_recv()
                except zenoh.ZError:  # the query has ended without an answer
                    break
                if reply is None:
                    time.sleep(0.002)
                    continue
                if reply.ok is not None:
                    return json.loads(reply.ok.payload.to_string())
                if reply.err is not None:
                    raise PeerError(reply.err.payload.to_string())
            time.sleep(0.02)
        raise PeerError(f"{self.role}: no answer to {what!r} within {timeout_s:g} s")
