"""A star on zenoh, over TCP: its centre listens, and everyone else connects with its secret.

There is no way to open one without a secret. zenoh asks who connects for it by challenge and
response, so that it is never sent, and lets nobody else in.
"""

import json
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import zenoh
from zenoh.handlers import FifoChannel

from noack.core.errors import CallerError

LEASE_MS = 2000
"""Whoever is silent for so long is gone."""
_CONNECT_MS = 5000
_SHAKE_HANDS_MS = 2000
"""Of those who have connected and not yet shown the secret, zenoh serves 100 at a time."""
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5}
"""Who finds that many before him comes again soon."""


class SessionSecret(NamedTuple):
    """What opens a star; neither part holds a colon or a line's end."""

    user: str
    password: str


def open_session(endpoint: str, secret: SessionSecret, *, listen: bool) -> zenoh.Session:
    """Open a session in a star.

    Args:
        endpoint: where the centre listens, e.g. ``tcp/127.0.0.1:7447``.
        secret: the centre lets in who has it; who connects shows it.
        listen: this is the centre.

    Raises:
        zenoh.ZError: the endpoint cannot be listened on, or reached; or the secret is wrong.
    """
    if not listen:
        shown = {f"transport/auth/usrpwd/{key}": value for key, value in secret._asdict().items()}
        return zenoh.open(session_config(endpoint, listen=False, more=shown))
    with _dictionary(secret) as path:
        more = {"transport/auth/usrpwd/dictionary_file": path}
        return zenoh.open(session_config(endpoint, listen=True, more=more))


@contextmanager
def _dictionary(secret: SessionSecret) -> Iterator[str]:
    """A file for zenoh, which reads passwords from nothing else, that never lies on a disk."""
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
    """Return the configuration of a star's centre (``listen``), or of one who connects to it.

    Args:
        endpoint: where the centre listens.
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
        f"{side}/retry": _RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "adminspace/enabled": False,  # it would tell the configuration, with the secret
        # Its shared-memory path would take payloads of 3 KiB and more past the socket.
        "transport/shared_memory/enabled": False,
        "transport/unicast/accept_timeout": _SHAKE_HANDS_MS,
        "transport/link/tx/lease": LEASE_MS,
        # A batch that finds no room is dropped at once; the loop does not wait for it.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    }
    for key, value in (settings | dict(more or {})).items():
        config.insert_json5(key, json.dumps(value))
    return config


def answer_to(session: zenoh.Session, key: str, question: str, timeout_s: float) -> str | None:
    """Ask a star's centre, and return its answer; None if there is none in time.

    Raises:
        CallerError: what was asked for is wrong; one line.
    """
    replies = session.get(key, FifoChannel(4), payload=question, timeout=timeout_s)
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        try:
            reply = replies.try_recv()
        except zenoh.ZError:  # the query has ended without an answer
            return None
        if reply is None:
            time.sleep(0.002)
        elif reply.ok is not None:
            return reply.ok.payload.to_string()
        elif reply.err is not None:
            raise CallerError(reply.err.payload.to_string())
    return None


def cause_of(error: zenoh.ZError) -> str:
    """Return what went wrong, in zenoh's words."""
    # zenoh ends its messages with the place in its own source.
    return str(error).partition(" at /")[0]
