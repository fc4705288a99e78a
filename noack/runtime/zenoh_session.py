"""zenoh sessions over TCP: one process listens, the others connect with a shared secret.

No session opens without a secret. zenoh checks it by challenge and response, so that it is never
sent, and refuses all other connections.
"""

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import zenoh
from zenoh.handlers import FifoChannel

from noack.core.errors import CallerError

LEASE_MS = 6000
"""A connection whose other end is silent for longer breaks. On a busy machine a process may not run
for seconds."""
_CONNECT_MS = 5000
_SHAKE_HANDS_MS = 2000
"""zenoh serves at most 100 connections at a time that have not yet shown the secret."""
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5}
"""Of a connection that finds 100 before it."""


class SessionSecret(NamedTuple):
    """User and password of a session; neither contains a colon or a line break."""

    user: str
    password: str


def open_session(endpoint: str, secret: SessionSecret, *, listen: bool) -> zenoh.Session:
    """Open a session that listens on the endpoint, or connects to it.

    Raise zenoh.ZError if that fails, or the secret is wrong.
    """
    if not listen:
        shown = {f"transport/auth/usrpwd/{key}": value for key, value in secret._asdict().items()}
        return zenoh.open(session_config(endpoint, listen=False, more=shown))
    with _dictionary(secret) as path:
        more = {"transport/auth/usrpwd/dictionary_file": path}
        return zenoh.open(session_config(endpoint, listen=True, more=more))


@contextmanager
def _dictionary(secret: SessionSecret) -> Iterator[str]:
    """A password file for zenoh that is never on a disk: zenoh reads passwords from files only."""
    reading, writing = os.pipe()
    try:
        with os.fdopen(writing, "w") as pipe:
            pipe.write(f"{secret.user}:{secret.password}\n")
        yield f"/dev/fd/{reading}"
    finally:
        os.close(reading)


def session_config(
    endpoint: str, *, listen: bool, more: Mapping[str, Any] | None = None
) -> zenoh.Config:
    """Return the zenoh configuration of a listening or of a connecting session.

    ``more`` has further zenoh settings by key.
    """
    config = zenoh.Config()
    side, other = ("listen", "connect") if listen else ("connect", "listen")
    settings: dict[str, Any] = {
        "mode": "router" if listen else "client",
        f"{side}/endpoints": [endpoint],
        f"{other}/endpoints": [],
        f"{side}/exit_on_failure": True,
        f"{side}/timeout_ms": _CONNECT_MS,
        f"{side}/retry": _RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "adminspace/enabled": False,  # it would publish the configuration with the secret
        # Shared memory would bypass the socket for payloads of 3 KiB and more.
        "transport/shared_memory/enabled": False,
        "transport/unicast/accept_timeout": _SHAKE_HANDS_MS,
        "transport/link/tx/lease": LEASE_MS,
        # Rows of many loops take more than the two default places of 64 KiB: they would never fit.
        "transport/link/tx/queue/size/background": 16,
        # A batch without room is dropped at once: the loop must not wait.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    }
    for key, value in (settings | dict(more or {})).items():
        config.insert_json5(key, json.dumps(value))
    return config


def answer_to(session: zenoh.Session, key: str, question: str, timeout_s: float) -> str | None:
    """Send a request to the listening session and return its answer; None without one in time.

    Raise CallerError if the request was refused as wrong.
    """
    replies = session.get(key, FifoChannel(4), payload=question, timeout=timeout_s)
    reply = first_reply(replies, time.monotonic() + timeout_s, poll_s=0.002)
    if reply is not None and reply.err is not None:
        raise CallerError(reply.err.payload.to_string())
    return None if reply is None or reply.ok is None else reply.ok.payload.to_string()


def first_reply(
    replies: Any, until_s: float, *, poll_s: float, give_up: Callable[[], bool] = lambda: False
) -> zenoh.Reply | None:
    """Return the first reply before a reading of the monotonic clock; None without one."""
    while time.monotonic() < until_s and not give_up():
        try:
            reply: zenoh.Reply | None = replies.try_recv()
        except zenoh.ZError:  # the query ended without an answer
            return None
        if reply is not None:
            return reply
        time.sleep(poll_s)
    return None


def label(key: str, header: bytes = b"") -> bytes:
    """Return the attachment of a message: the key with which it is sent, and a header."""
    return b"\n".join((key.encode(), header))


def header_of(sample: zenoh.Sample) -> bytes | None:
    """Return the header of a message; None if it was sent with another key.

    On an overloaded machine, after connections had broken, zenoh delivered a message to the
    subscriber of another key: a confirmation of rows as a request to stop.
    """
    attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
    key, _, header = attachment.partition(b"\n")
    return header if key == str(sample.key_expr).encode() else None


def next_payload(subscriber: Any) -> bytes | None:
    """Return the payload of a subscriber's next message with its key; None without one."""
    while (sample := subscriber.try_recv()) is not None:
        if header_of(sample) is not None:
            payload: bytes = sample.payload.to_bytes()
            return payload
    return None


def cause_of(error: zenoh.ZError) -> str:
    """Return zenoh's message without the place in its own source."""
    return str(error).partition(" at /")[0]
