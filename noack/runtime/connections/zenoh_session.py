"""Sessions of zenoh over a Unix socket in the user's runtime directory, requests and replies.

Of a run's control plane, of the emulator's live control, and of the doctor's measurement of zenoh.
"""

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache

import zenoh
from zenoh.handlers import FifoChannel, Handler

from noack.core.errors import CallerError, NoAnswerError
from noack.runtime.address import address_text
from noack.runtime.private_folder import open_private
from noack.runtime.run_descriptor import RemoteAccess

_LEASE_MS = 6000
"""A connection whose other end is silent for longer breaks. On a busy machine a process may not run
for seconds."""
_CONNECT_MS = 5000
"""Longest wait for a connection."""
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5}
"""Of a connection whose other end does not answer."""
_FIRST_POLL_S, _POLL_SHARE = 0.001, 0.05
"""Time between two checks for a reply: at first, and as a share of the time waited so far."""


def open_session(kind: str, name: str, *, listen: bool) -> zenoh.Session:
    """Open a session that listens on a socket, or connects to it.

    The socket is ``NAME.sock`` in the folder ``kind`` of the user's runtime directory. Raise
    zenoh.ZError if that fails, CallerError if other users have access to the folder.
    """
    return zenoh.open(session_config(socket_path(kind, name), listen=listen))


@contextmanager
def open_remote_session(remote: RemoteAccess, key: bytes) -> Iterator[zenoh.Session]:
    """Give a session with a coordinator on another host, in a run with this key.

    Raise NoAnswerError if that fails, MachineError if the link to the coordinator cannot be
    started, CallerError if other users have access to the user's runtime directory.
    """
    # Processes on the coordinator's host need neither TLS nor asyncio.
    from noack.runtime.connections.coordinator_link import Destination, coordinator_link

    credentials = remote.coordinator, remote.certificate, remote.private_key
    destination = Destination(remote.host, remote.port, *credentials, key.hex())
    address = address_text((remote.host, remote.port))
    with ExitStack() as stack:
        try:
            path = stack.enter_context(coordinator_link(destination))
            session = zenoh.open(session_config(path, listen=False))
        except (NoAnswerError, zenoh.ZError) as error:
            reason = error if isinstance(error, NoAnswerError) else cause_of(error)
            raise NoAnswerError(f"cannot reach the run at {address}: {reason}") from None
        yield session


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


def session_config(path: str, *, listen: bool) -> zenoh.Config:
    """Return the zenoh configuration of a session that listens on a socket, or connects to it."""
    config = zenoh.Config()
    side, other_side = ("listen", "connect") if listen else ("connect", "listen")
    settings: dict[str, object] = {
        "mode": "router" if listen else "client",
        f"{side}/endpoints": [f"unixsock-stream/{path}"],
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
    """Return zenoh's message without the place in its own source."""
    return str(error).partition(" at /")[0]
