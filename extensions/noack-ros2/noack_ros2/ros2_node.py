"""A node in the graph of ROS 2, in the wire form of rmw_zenoh, without an installation of ROS.

A topic is the key ``DOMAIN/TOPIC/TYPE/HASH``; a message is its CDR bytes, with an attachment:
number, time, and the sender's 16 bytes of identity, each with its length where it has one. Nodes
and ends of topics show themselves by liveliness tokens below ``@ros2_lv``. The form is that of
rmw_zenoh from the distribution jazzy on; before, there were no hashes of types.
"""

import hashlib
import json
import re
import struct
import sys
import time
from collections import Counter
from typing import Self

import zenoh
from zenoh import CongestionControl, Priority
from zenoh.handlers import Handler, RingChannel

from noack.extend import CallerError
from noack_ros2 import ros2_messages as ros2
from noack_ros2.ros2_messages import DEFAULT_ROUTER, JOINT_STATE, Entries

_QOS = "::,10:,:,:,,"
"""Reliable, volatile, the last 10 messages; what is empty is rmw_zenoh's default."""
_ATTACHMENT, _GID_BYTES = struct.Struct("<qqB"), 16
_OPEN_MS, _LEASE_MS = 3000, 2000
"""Longest wait for a connection with the router, and longest silence of it."""
_WAITING = 256
"""Messages that wait until they are read; later ones replace the oldest."""
_MOST_CAUSES = 4
"""Causes for which messages are skipped that are told apart."""
_POLL_S = 0.0002
"""Time between two looks for an answer."""


def topic_key(domain: int, topic: str) -> str:
    """Return the key of a topic's messages."""
    return f"{domain}/{topic.strip('/')}/{_type_name()}/{ros2.type_hash(JOINT_STATE)}"


def _type_name() -> str:
    package, _, name = JOINT_STATE.split("/")
    return f"{package}::msg::dds_::{name}_"


_ENDPOINT = re.compile(r"[a-z]+/.+:\d+")


def _session(endpoint: str, *, listen: bool) -> zenoh.Session:
    """Open a session with a router, or as the router to which nodes connect."""
    if not _ENDPOINT.fullmatch(endpoint):
        raise CallerError(f"router {endpoint}: give it as tcp/127.0.0.1:7447")
    config = zenoh.Config()
    side, other_side = ("listen", "connect") if listen else ("connect", "listen")
    settings: dict[str, object] = {
        "mode": "router" if listen else "client",
        f"{side}/endpoints": [endpoint],
        f"{other_side}/endpoints": [],
        f"{side}/exit_on_failure": True,
        f"{side}/timeout_ms": _OPEN_MS,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": listen,  # a router of ROS 2 tells its nodes of each other
        "scouting/delay": 0,
        "adminspace/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
    }
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = str(error).partition(" at /")[0]
        task = "listen on" if listen else "reach a router of ROS 2 at"
        raise CallerError(f"cannot {task} {endpoint}: {reason}") from None


class Publisher:
    """One topic of a node."""

    def __init__(self, session: zenoh.Session, key: str, token: str) -> None:
        self._session, self._key, self._sent = session, key, 0
        self._gid = hashlib.blake2b(token.encode(), digest_size=_GID_BYTES).digest()

    def publish(self, entries: Entries, frame: str, *, urgent: bool = False) -> None:
        """Send a message; it is dropped if the connection has no room."""
        self._sent += 1
        attachment = _ATTACHMENT.pack(self._sent, time.time_ns(), _GID_BYTES) + self._gid
        self._session.put(
            self._key,
            ros2.joint_state(entries, frame),
            attachment=attachment,
            congestion_control=CongestionControl.DROP,
            priority=Priority.REAL_TIME if urgent else Priority.BACKGROUND,
        )


class Node:
    """A node; close it at the end.

    Args:
        name: name of the node.
        endpoint: address of the router, as zenoh writes it.
        domain: the ``ROS_DOMAIN_ID``.
        listen: whether the node is itself the router, to which the other nodes connect.

    Raises:
        CallerError: there is no router.
    """

    def __init__(
        self, name: str, endpoint: str = DEFAULT_ROUTER, domain: int = 0, *, listen: bool = False
    ) -> None:
        self._name, self._domain = name, domain
        self._session = _session(endpoint, listen=listen)
        self._tokens: list[zenoh.LivelinessToken] = []
        self._declare(f"{self._entity('NN')}/%/%/{name}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the graph."""
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]

    def publisher(self, topic: str) -> Publisher:
        """Add a topic to which this node sends."""
        return Publisher(self._session, topic_key(self._domain, topic), self._end("MP", topic))

    def subscription(self, topic: str) -> "zenoh.Subscriber[Handler[zenoh.Sample]]":
        """Add a topic that this node receives; the newest messages wait."""
        self._end("MS", topic)
        return self._session.declare_subscriber(topic_key(self._domain, topic), RingChannel(_WAITING))

    def _entity(self, kind: str) -> str:
        number = len(self._tokens)  # the node is 0, its ends count from 1
        return f"@ros2_lv/{self._domain}/{self._session.info.zid()}/0/{number}/{kind}"

    def _end(self, kind: str, topic: str) -> str:
        mangled = "/" + topic.strip("/")
        token = "/".join(
            (
                self._entity(kind),
                "%",
                "%",
                self._name,
                mangled.replace("/", "%"),
                _type_name(),
                ros2.type_hash(JOINT_STATE),
                _QOS,
            )
        )
        self._declare(token)
        return token

    def _declare(self, token: str) -> None:
        self._tokens.append(self._session.liveliness().declare_token(token))


def _identity(sample: zenoh.Sample) -> bytes:
    """Return the identity of the sender in a message's attachment; empty if it has none."""
    attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
    is_whole = len(attachment) == _ATTACHMENT.size + _GID_BYTES
    return attachment[_ATTACHMENT.size :] if is_whole else b""


class TopicExchange:
    """Asks a node: a message on one topic, the answer with the same stamp on another.

    Other nodes may send on the topic of the answers, too. Answers count that come from the sender
    of the first one, and are whole; others are skipped, counted, and named once on standard error.

    Args:
        node: this side.
        ask: topic of the questions.
        answer: topic of the answers.
        frame: name of the loop.
    """

    def __init__(self, node: Node, ask: str, answer: str, frame: str) -> None:
        self._answers, self._questions = node.subscription(answer), node.publisher(ask)
        self._topics, self._frame = (ask, answer), frame
        self._sender: bytes | None = None
        self.skipped: Counter[str] = Counter()
        """Messages that were skipped, by cause."""

    def ask(self, entries: Entries, count: int, timeout_s: float, *, again_s: float | None = None) -> Entries:
        """Send a question and wait for the answer, which has ``count`` values.

        Args:
            entries: the question.
            count: number of values of an answer.
            timeout_s: longest wait.
            again_s: send it again after this time: a node may not be connected yet.

        Raises:
            TimeoutError: there is no valid answer in time.
        """
        began_s = sent_s = time.monotonic()
        self._questions.publish(entries, self._frame, urgent=True)
        while (now_s := time.monotonic()) - began_s < timeout_s:
            if (sample := self._answers.try_recv()) is None:
                if again_s is not None and now_s - sent_s > again_s:
                    sent_s = now_s
                    self._questions.publish(entries, self._frame, urgent=True)
                time.sleep(_POLL_S)
                continue
            sender = _identity(sample)
            if self._sender is not None and sender != self._sender:
                self._skip("of another sender than the first answer")
                continue
            try:
                answer = ros2.read_joint_state(sample.payload.to_bytes())
            except ValueError as error:
                self._skip(str(error))
                continue
            if answer.stamp_ns != entries.stamp_ns:
                continue  # the answer to a question that was sent again
            if len(answer.values) != count:
                self._skip(f"{len(answer.values)} values in `position`; {count} needed")
                continue
            self._sender = sender
            return answer
        ask, reply = self._topics
        causes = "".join(f"; skipped {n} messages: {cause}" for cause, n in self.skipped.items())
        raise TimeoutError(f"no answer on {reply} to {ask} within {timeout_s:g} s{causes}")

    def _skip(self, cause: str) -> None:
        if len(self.skipped) >= _MOST_CAUSES and cause not in self.skipped:
            cause = "others"
        if not self.skipped[cause]:
            print(f"noack: warning: {self._topics[1]}: skipped a message: {cause}", file=sys.stderr)
        self.skipped[cause] += 1
