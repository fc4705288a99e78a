"""Sessions of zenoh over a Unix socket in the user's runtime directory, or TLS; requests and replies.

Of a run's control plane, and of the doctor's measurement of zenoh.
"""

import json
import os
import time
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import zenoh
from zenoh.handlers import FifoChannel, Handler

from netem.core.address import Address, address_text
from netem.core.errors import CallerError
from netem.core.private_folder import open_private

_LEASE_MS = 6000
"""A connection whose other end is silent for longer breaks. On a busy machine a process may not run
for seconds."""
_CONNECT_MS = 5000
"""Longest wait for a connection."""
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5}
"""Of a connection whose other end does not answer."""
_FIRST_POLL_S, _POLL_SHARE = 0.001, 0.05
"""Time between two checks for a reply: at first, and as a share of the time waited so far."""


class TlsEndpoint(NamedTuple):
    """Where a session is reached from other hosts, and zenoh's settings for that."""

    address: Address
    tls: dict[str, object]
    access_control: dict[str, object] | None = None
    """Of the end that listens: which messages each other end may send."""

    @property
    def endpoint(self) -> str:
        """The endpoint in zenoh's form."""
        return f"tls/{address_text(self.address)}"


def open_session(kind: str, name: str, *, listen: bool, remote: TlsEndpoint | None = None) -> zenoh.Session:
    """Open a session that listens on a socket, or connects to it.

    The socket is ``NAME.sock`` in the folder ``kind`` of the user's runtime directory. A session that
    listens does so for other hosts, too, if ``remote`` is given. Raise zenoh.ZError if that fails,
    CallerError if other users have access to the folder.
    """
    endpoints = [f"unixsock-stream/{socket_path(kind, name)}"]
    return zenoh.open(session_config(endpoints, listen=listen, remote=remote))


def open_remote_session(remote: TlsEndpoint) -> zenoh.Session:
    """Connect to a session on another host; raise zenoh.ZError if that fails."""
    return zenoh.open(session_config([], listen=False, remote=remote))


def socket_path(kind: str, name: str) -> str:
    """Return the path of a socket, in the words of this process.

    It may have at most 107 bytes, so it goes through an open descriptor.
    """
    with open_private(kind, create=True) as folder:
        status = os.fstat(folder.descriptor)
        descriptor = _lasting_copy(folder.descriptor, status.st_dev, status.st_ino)
    return f"/proc/self/fd/{descriptor}/{name}.sock"


@cache
def _lasting_copy(descriptor: int, device: int, inode: int) -> int:
    """Return a copy of a folder's descriptor; it stays open, because zenoh may connect again."""
    return os.dup(descriptor)


def session_config(endpoints: list[str], *, listen: bool, remote: TlsEndpoint | None = None) -> zenoh.Config:
    """Return the zenoh configuration of a session that listens on endpoints, or connects to them."""
    config = zenoh.Config()
    side, other_side = ("listen", "connect") if listen else ("connect", "listen")
    settings: dict[str, object] = {
        "mode": "router" if listen else "client",
        f"{side}/endpoints": endpoints if remote is None else [*endpoints, remote.endpoint],
        f"{other_side}/endpoints": [],
        f"{side}/exit_on_failure": True,
        f"{side}/timeout_ms": _CONNECT_MS,
        f"{side}/retry": _RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "adminspace/enabled": False,  # it would publish the configuration
        # Shared memory would bypass the socket for payloads of 3 KiB and more.
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        # Rows of many loops take more than the two default places of 64 KiB: they would never fit.
        "transport/link/tx/queue/size/background": 16,
        # A batch without room is dropped at once: the loop must not wait.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
    }
    if remote is not None:
        settings["transport/link/tls"] = remote.tls
        if remote.access_control is not None:
            settings["access_control"] = remote.access_control
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def answer_to(session: zenoh.Session, key: str, question: str | bytes, timeout_s: float) -> str | None:
    """Send a request to the listening session and return its answer; None without one in time.

    Raise CallerError if the request was refused as wrong.
    """
    replies = session.get(key, FifoChannel(4), payload=question, timeout=timeout_s)
    reply = first_reply(replies, time.monotonic() + timeout_s, poll_s=0.002)
    if reply is not None and reply.err is not None:
        raise CallerError(reply.err.payload.to_string())
    return None if reply is None or reply.ok is None else reply.ok.payload.to_string()


def first_reply(
    replies: Handler[zenoh.Reply],
    until_s: float,
    *,
    poll_s: float,
    give_up: Callable[[], bool] = lambda: False,
) -> zenoh.Reply | None:
    """Return the first reply before a reading of the monotonic clock; None without one.

    ``poll_s`` is the longest time between two looks, which are more frequent in the beginning.
    """
    began_s = time.monotonic()
    while (now_s := time.monotonic()) < until_s and not give_up():
        try:
            reply = replies.try_recv()
        except zenoh.ZError:  # the query ended without an answer
            return None
        if reply is not None:
            return reply
        time.sleep(min(poll_s, _FIRST_POLL_S + _POLL_SHARE * (now_s - began_s)))
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


def next_payload(subscriber: "zenoh.Subscriber[Handler[zenoh.Sample]]") -> bytes | None:
    """Return the payload of a subscriber's next message with its key; None without one."""
    while (sample := subscriber.try_recv()) is not None:
        if header_of(sample) is not None:
            return sample.payload.to_bytes()
    return None


def cause_of(error: zenoh.ZError) -> str:
    """Return zenoh's message without the place in its own source; in plain words if nobody answered."""
    cause = str(error).partition(" at /")[0]
    if cause.startswith("Unable to connect to any of"):
        return f"no connection within {_CONNECT_MS / 1000:g} s; the process is stopped, busy or has ended"
    return cause
