"""The control plane of a run: start barrier, liveliness, stop, telemetry, all on zenoh.

Loop data never travels here, and the loop never waits for it. The coordinator listens on a Unix
socket in the user's runtime directory, which is closed to other users; all other processes connect
to it. From another host, a session connects through ``connections/coordinator_link.py`` by TLS to
:mod:`cosim.live.remote_access`, which forwards to that socket. Both ends have certificates of the
run.

The launcher keeps a lock file for its run beside the socket. By these files other programs of the
user find the active runs, and change their settings.
"""

import json
import os
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, Self

import zenoh
from pydantic import ConfigDict, TypeAdapter, ValidationError
from zenoh import CongestionControl, Priority
from zenoh.handlers import FifoChannel, Handler, RingChannel

from noack.core.errors import CallerError, NoAnswerError, PeerError
from noack.impairments.loss_prediction import remember
from noack.protocol.roles import COORDINATOR
from noack.runtime.address import address_text
from noack.runtime.control_messages import (
    ChangeAnnouncement,
    ChangeReply,
    ChangeRequest,
    message_json,
    parse_message,
)
from noack.runtime.private_folder import LockFile, live_lock_files, lock_file, open_private
from noack.runtime.run_descriptor import RemoteAccess, RunDescriptor
from noack.runtime.spool import writer_of
from noack.scenario.runtime_parameters import require_finite
from noack.scenario.scenario_tables import MOST_CHANGES
from noack.scenario.toml_file import brief

LEASE_MS = 6000
"""A connection whose other end is silent for longer breaks. On a busy machine a process may not run
for seconds."""
_CONNECT_MS = 5000
_RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5}
"""Of a connection whose other end does not answer."""
_FOLDERS: dict[Path, int] = {}
"""Descriptors of folders with sockets; they stay open, because zenoh may connect again."""
_REQUEST_AGAIN_S = 5.0
_POLL_S = 0.01
"""Twenty runs that wait at the start barrier are a hundred processes that poll at this rate."""
RUNS = "runs"
"""Folder of the active runs in the user's runtime directory: sockets, lock files."""
_FIRST_POLL_S, _POLL_SHARE = 0.001, 0.05
"""Time between two looks for a reply: at first, and as a share of the time waited so far."""
_ANSWER_S = 30.0
"""Longest wait for the answer to a change of settings."""


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
        descriptor = _FOLDERS.get(folder.path)
        if descriptor is None or not os.path.samestat(os.fstat(descriptor), os.fstat(folder.descriptor)):
            descriptor = _FOLDERS[folder.path] = os.dup(folder.descriptor)
    return f"/proc/self/fd/{descriptor}/{name}.sock"


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
        "transport/link/tx/lease": LEASE_MS,
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


def run_name(run_id: int) -> str:
    """Return a run's name in that folder and in the keys of its control plane."""
    return f"{run_id:016x}"


class ControlPlane:
    """The connection of a process (``role``) to the control plane of a run.

    Every key lies below ``noack/RUN``. With ``listen`` the process is the coordinator. Raise
    NoAnswerError if the coordinator cannot be reached, or the socket cannot be listened on;
    CallerError if other users have access to the user's runtime directory.
    """

    def __init__(self, descriptor: RunDescriptor, role: str, *, listen: bool = False) -> None:
        self._prefix = f"noack/{run_name(descriptor.run_id)}"
        self.role = role
        self.secret = secrets.token_hex(32)
        self.instance = writer_of(self.secret)
        self._resources = ExitStack()
        try:
            self.session = (
                open_session(RUNS, run_name(descriptor.run_id), listen=listen)
                if descriptor.remote is None
                else self._resources.enter_context(open_remote_session(descriptor.remote, descriptor.key))
            )
        except zenoh.ZError as error:
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
        self._done: set[str] = set()
        self._persisted = session.declare_subscriber(key("persisted", role), RingChannel(1))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the session; this process's liveliness token vanishes."""
        if not self.session.is_closed():
            self.session.close()  # type: ignore[no-untyped-call]
        self._resources.close()

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
            gone = life.kind == zenoh.SampleKind.DELETE
            self._coordinator_gone_s = time.monotonic() if gone else None
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

    def persisted(self) -> bytes | None:
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
        self._done.add(self.role)
        self.publish("done", self.role, content=self.role, priority=Priority.REAL_TIME)

    def done(self) -> set[str]:
        """The roles whose process has announced that it is done."""
        while (role := next_payload(self._dones)) is not None:
            self._done.add(role.decode(errors="replace"))
        return self._done

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
        raise NoAnswerError(f"no answer to {queryable!r} within {timeout_s:g} s")


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
            remember(announced.target_losses)
            if announced.number >= self._next_number:  # a late process receives some twice
                self._next_number = announced.number + 1
                updates.append(announced)
        return updates


class OpenRun(NamedTuple):
    """How to reach a run."""

    name: str  # of its socket, and in the keys of its control plane
    run_dir: str
    session: str | None  # session name for processes started by hand; None if all were launched


_OPEN_RUN = TypeAdapter(OpenRun, config=ConfigDict(defer_build=True))


@contextmanager
def registered_run(descriptor: RunDescriptor, session: str | None) -> Iterator[Path]:
    """Keep a run's lock file while the context lasts."""
    run = OpenRun(run_name(descriptor.run_id), descriptor.run_dir, session)
    with lock_file(RUNS, run.name, run._asdict()) as path:
        yield path


def active_runs() -> list[OpenRun]:
    """Return the user's active runs. Raise PeerError if the file of one is not valid."""
    return [_open_run(file) for file in live_lock_files(RUNS)]


def find_run(session: str | None = None, run_dir: Path | None = None) -> OpenRun:
    """Return the user's active run, of this session or with this run directory.

    Raise CallerError if no such run is active, or several are.
    """
    runs = active_runs()
    fitting = [
        run
        for run in runs
        if (session is None or run.session == session)
        and (run_dir is None or Path(run.run_dir) == run_dir.resolve())
    ]
    if len(fitting) == 1:
        return fitting[0]
    if not runs:
        raise CallerError("no run is active; start one, e.g. `noack demo`")
    active = "active: " + ", ".join(run.run_dir for run in fitting or runs)
    if fitting:
        raise CallerError(f"several runs are {active}; choose one by --run DIRECTORY")
    criterion = f"in session {session!r}" if run_dir is None else f"in {run_dir}"
    raise CallerError(f"no run is active {criterion}; {active}")


def request_change(run: OpenRun, settings: Mapping[str, object]) -> ChangeReply:
    """Request a change of runtime parameters; without settings, their values. Return the answer.

    Raise CallerError, with one line per mistake, for wrong settings, PeerError without an answer.
    """
    require_finite(settings)
    request = message_json(ChangeRequest.model_validate({"settings": dict(settings)}))
    try:
        with open_session(RUNS, run.name, listen=False) as plane:
            answer = answer_to(plane, f"noack/{run.name}/runtime_parameters", request, _ANSWER_S)
    except zenoh.ZError as error:
        raise PeerError(f"{run.run_dir}: the run cannot be reached: {cause_of(error)}") from None
    if answer is None:
        raise PeerError(f"{run.run_dir}: the run does not answer")
    return parse_message(ChangeReply, answer)


def _open_run(file: LockFile) -> OpenRun:
    try:
        return _OPEN_RUN.validate_json(file.content, strict=True)
    except ValidationError as error:
        raise PeerError(f"{file.path}: not a valid file of an active run: {brief(error)}") from None
