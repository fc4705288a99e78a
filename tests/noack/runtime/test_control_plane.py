"""Access to the control plane: only over loopback, and only with the run's key."""

import hashlib
import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, cast

import psutil
import pytest
import zenoh
from zenoh.handlers import FifoChannel, RingChannel

import noack.runtime.control_plane
import noack.runtime.process_entry
from cosim.live.coordinator import Coordinator
from noack.config.resolution import resolve
from noack.config.scenario_file import validate
from noack.core.errors import NoAnswerError, PeerError
from noack.protocol.topology import COORDINATOR, LOOP_ROLES
from noack.runtime.control_messages import Admission, MissingRows, RunStart, parse_message
from noack.runtime.control_plane import ControlPlane, secret_of
from noack.runtime.join_ticket import Ticket, new_ticket
from noack.runtime.process_entry import _admitted
from noack.runtime.process_life import RunProcess
from noack.runtime.signals import Signals
from noack.runtime.udp_sockets import free_tcp_port
from noack.runtime.zenoh_session import SessionSecret, label, open_session, session_config
from tests.fuzz.plane import FakePlane
from tests.integration.conftest import wait_for

HELLO = '{"pid": 1, "instance": "evil", "address": ["127.0.0.1", 9]}'
STRANGERS = ["no secret", "wrong password", "wrong user", "no password", "another run's"]


@pytest.fixture
def ticket(content: dict[str, Any], tmp_path: Path) -> Ticket:
    endpoint = f"tcp/127.0.0.1:{free_tcp_port()}"
    return new_ticket(resolve(validate(content, "")), endpoint, tmp_path, launched=True)


@pytest.fixture
def coordinator(ticket: Ticket) -> Iterator[Coordinator]:
    coordinator = Coordinator(ticket)
    yield coordinator
    coordinator.close()


def changed(ticket: Ticket, **update: Any) -> Ticket:
    return ticket.model_copy(update=update)


def shown_by(stranger: str, ticket: Ticket) -> dict[str, str]:
    """The credentials that a connection without the key presents."""
    own = secret_of(ticket)
    secrets = {
        "wrong password": SessionSecret(own.user, "0" * len(own.password)),
        "wrong user": SessionSecret("root", own.password),
        "no password": SessionSecret(own.user, ""),
        "another run's": secret_of(changed(ticket, key=bytes(32), run_id=ticket.run_id ^ 1)),
    }
    if stranger not in secrets:
        return {}
    return {f"transport/auth/usrpwd/{k}": v for k, v in secrets[stranger]._asdict().items()}


def test_a_connection_without_the_secret_is_refused(
    coordinator: Coordinator, ticket: Ticket
) -> None:
    def connect(attempt: tuple[str, str]) -> None:
        stranger, mode = attempt
        more = {"mode": mode, "connect/timeout_ms": 200, **shown_by(stranger, ticket)}
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            zenoh.open(session_config(ticket.endpoint, listen=False, more=more))

    attempts = list(product(STRANGERS, ("client", "peer", "router")))
    with ThreadPoolExecutor(len(attempts)) as pool:
        list(pool.map(connect, attempts))


def test_a_refused_session_neither_sends_nor_receives(
    coordinator: Coordinator, ticket: Ticket
) -> None:
    """The refused sessions stay open and reconnect repeatedly, as zenoh's do by default."""
    strangers = []
    for stranger in STRANGERS:
        more = {"connect/exit_on_failure": False, "connect/timeout_ms": 0, "mode": "peer"}
        more |= shown_by(stranger, ticket)
        config = session_config(ticket.endpoint, listen=False, more=more)
        strangers.append(zenoh.open(config))
    with ControlPlane(ticket, "plant") as plant:
        batches = coordinator.plane.session.declare_subscriber(
            plant.key("telemetry", "**"), RingChannel(100)
        )
        reports = coordinator.plane.session.declare_queryable(
            plant.key("report", "*"), FifoChannel(100)
        )
        received = [session.declare_subscriber("**", RingChannel(100)) for session in strangers]
        lives = [
            session.liveliness().declare_subscriber("**", RingChannel(100), history=True)
            for session in strangers
        ]
        asked = []
        for session in strangers:
            for key in ("stop", f"ended/plant/{plant.instance}", "progress",
                        "telemetry/plant/plant_step", "persisted/plant"):  # fmt: skip
                full = plant.key(*key.split("/"))
                session.put(full, "evil", attachment=label(full))
            session.liveliness().declare_token(plant.key("alive", "sensor", "evil"))
            for what in ("admit", "join", "report"):
                key = plant.key(what, "plant")
                asked.append(session.get(key, FifoChannel(4), payload=HELLO, timeout=0.3))
        plant.publish_telemetry_blocking("plant_step", b"{}", b"own")
        # A later message on the same path: once it has arrived, all earlier ones have arrived, too.
        wait_for(lambda: (sample := batches.try_recv()) is not None and _is_own(sample))
        coordinator.poll()
        assert batches.try_recv() is None
        assert reports.try_recv() is None
        assert coordinator.missing() == (*LOOP_ROLES, "recorder")
        assert coordinator.failures() == {}
        assert coordinator.progress() is None
        assert plant.stop_requested() is None
        assert plant.persisted() is None
        for channel in (*received, *lives):  # each receives its own messages only
            while (sample := channel.try_recv()) is not None:
                assert sample.payload.to_bytes() in (b"", b"evil")
                assert sample.payload.to_bytes() or "alive/sensor" in str(sample.key_expr)
        for replies in asked:
            assert all(reply.ok is None for reply in replies)
    for session in strangers:
        session.close()  # type: ignore[no-untyped-call]


def _is_own(sample: zenoh.Sample) -> bool:
    assert sample.payload.to_bytes() == b"own"
    return True


def test_a_message_that_arrives_under_another_key_is_ignored(
    coordinator: Coordinator, ticket: Ticket
) -> None:
    """zenoh once delivered a confirmation of rows as a request to stop."""
    with ControlPlane(ticket, "plant") as plant:
        listener, sent_as = coordinator.plane, label(plant.key("persisted", "plant"))

        def arrives() -> bool:
            listener.acknowledge_rows("plant", {"rows": {}})
            return plant.persisted() is not None

        wait_for(arrives)  # the listener knows the subscriptions
        for key in ("stop", "change"):
            listener.session.put(plant.key(key), "misdelivered", attachment=sent_as)
            listener.session.put(plant.key(key), "without a label")
        listener.announce_change("own")
        changes: list[bytes] = []
        wait_for(lambda: changes.append(plant.next_change() or b"") or any(changes))
        assert max(changes) == b'"own"'  # the earlier ones have arrived, too
        assert plant.stop_requested() is None
        listener.request_stop("enough")
        wait_for(lambda: plant.stop_requested() == "enough")


def test_a_process_refuses_an_endpoint_without_authentication(ticket: Ticket) -> None:
    """Another process has taken a dead coordinator's port and does not have the key."""
    secret = secret_of(ticket)._asdict()
    shown = {f"transport/auth/usrpwd/{key}": value for key, value in secret.items()}
    more = {"connect/timeout_ms": 200, **shown}
    config = session_config(ticket.endpoint, listen=False, more=more)
    with (
        zenoh.open(session_config(ticket.endpoint, listen=True)),
        pytest.raises(zenoh.ZError, match="Unable to connect"),
    ):
        zenoh.open(config)


def test_the_secret_is_derived_as_documented(ticket: Ticket) -> None:
    known = changed(ticket, run_id=0x0123456789ABCDEF, key=bytes(range(32)))
    password = hashlib.blake2b(
        b"the control plane's password", key=bytes(range(32)), digest_size=32
    ).hexdigest()
    assert secret_of(known) == ("0123456789abcdef", password)
    assert known.key.hex() not in password


def test_the_coordinator_listens_on_loopback_only(coordinator: Coordinator, ticket: Ticket) -> None:
    port = int(ticket.endpoint.rpartition(":")[2])
    own = psutil.Process().net_connections()
    listening = {c.laddr for c in own if c.status == psutil.CONN_LISTEN}
    assert [address.ip for address in listening if address.port == port] == ["127.0.0.1"]
    assert not any(c.laddr.port in (7446, 7447) for c in own)  # zenoh's scouting, its default port


def test_every_zenoh_session_needs_a_secret() -> None:
    root = Path(noack.__file__).parents[1]
    rooms = ("noack", "netem", "cosim", "plant_server", "sensor_node", "controller_node")
    files = [file for room in rooms for file in (root / room).rglob("*.py")]
    assert [file.name for file in files if "zenoh.open" in file.read_text()] == ["zenoh_session.py"]


def test_the_password_is_not_stored_on_disk_and_no_pipe_stays_open(ticket: Ticket) -> None:
    own, before = psutil.Process(), pipes()
    with open_session(ticket.endpoint, secret_of(ticket), listen=True):
        assert not [f for f in own.open_files() if "password" in f.path]
        assert pipes() == before


def pipes() -> set[str]:
    links = []
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            links.append(str(descriptor.readlink()))
    return {link for link in links if link.startswith("pipe:")}


@pytest.mark.parametrize(
    ("answer", "kind", "line"),
    [
        ("", Admission, "not a valid admission: "),
        (b"\xff\xfe", Admission, "not a valid admission: "),
        ("[" * 100_000, Admission, "not a valid admission: "),
        ('{"epoch_ns": -1, "addresses": {}}', RunStart, "epoch_ns: "),
        ('{"epoch_ns": 1, "addresses": {"plant": ["127.0.0.1", 0]}}', RunStart, "plant"),
        ('{"epoch_ns": 1, "addresses": {"plant": ["plant.lan", 5]}}', RunStart, "plant"),
        ("null", MissingRows, "not a valid missing rows: "),
        ('{"rows": {"plant_step": [[0]]}}', MissingRows, "plant_step"),
        ('{"rows": {"plant_step": [[0, -5]]}}', MissingRows, "plant_step"),
    ],
)
def test_an_invalid_message_gives_one_line(answer: str | bytes, kind: Any, line: str) -> None:
    with pytest.raises(PeerError) as caught:
        parse_message(kind, answer)
    assert line in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 500


def test_a_request_is_sent_again_when_its_answer_was_lost_and_its_answer_arrives_unchanged(
    coordinator: Coordinator, ticket: Ticket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(noack.runtime.control_plane, "_REQUEST_AGAIN_S", 0.2)
    answer = {"epoch_ns": 7, "addresses": dict.fromkeys(LOOP_ROLES, ("127.0.0.1", 5)), "more": [1]}
    queries = coordinator.plane.session.declare_queryable(
        coordinator.plane.key("ask", "*"), FifoChannel(4)
    )
    unanswered = []

    def serve() -> None:
        unanswered.append(queries.recv())
        ControlPlane.answer(queries.recv(), answer)

    threading.Thread(target=serve, daemon=True).start()
    with ControlPlane(ticket, "plant") as plant:
        received = parse_message(RunStart, plant.request("ask", {}, timeout_s=30))
        assert received["epoch_ns"] == 7
        assert received["addresses"] == dict.fromkeys(LOOP_ROLES, ("127.0.0.1", 5))
        # The message must not read ``noack plant: plant: no answer``.
        with pytest.raises(PeerError, match=r"^no answer to 'nothing'"):
            plant.request("nothing", {}, timeout_s=0.05)
    unanswered.clear()


@pytest.mark.parametrize("launched", [True, False])
def test_a_launched_process_connects_again_until_it_is_admitted(
    ticket: Ticket, monkeypatch: pytest.MonkeyPatch, launched: bool
) -> None:
    """A connection without answers does not recover; started by a person, a process reports it."""
    tries: list[FakePlane] = []

    class Silent(FakePlane):
        def __init__(self, _ticket: Ticket, role: str) -> None:
            super().__init__()
            tries.append(self)
            if len(tries) == 1:
                raise NoAnswerError("cannot reach the run's coordinator")

        def request(self, what: str, *_: object, **__: object) -> bytes:
            if len(tries) < 3:
                raise NoAnswerError(f"no answer to {what!r}")
            admission = {"generation": 0, "admitted_ns": 0, "from_ns": 0}
            return json.dumps(admission | {"address": None, "replaces": None}).encode()

    monkeypatch.setattr(noack.runtime.process_entry, "ControlPlane", Silent)
    monkeypatch.setattr(noack.runtime.process_entry, "lifeline_cut", lambda: False)
    asking = partial(_admitted, "plant", changed(ticket, launched=launched), Signals())
    if launched:
        assert asking().plane is cast(Any, tries[2])
        assert [one.is_closed for one in tries] == [False, True, False]
    else:
        with pytest.raises(NoAnswerError, match="cannot reach"):
            asking()


def meet(plane: ControlPlane) -> None:
    """Wait until a process has found the coordinator."""
    everyone = plane.key("alive", COORDINATOR, "*")
    wait_for(lambda: any(one.ok for one in plane.session.liveliness().get(everyone)))


def test_a_short_loss_of_the_coordinator_is_tolerated(ticket: Ticket) -> None:
    """The machine did not run one end of the connection for longer than a lease."""
    ticket = changed(ticket, launched=False)
    first = Coordinator(ticket)
    with ControlPlane(ticket, "plant") as plane, ThreadPoolExecutor() as pool:
        process = RunProcess("plant", ticket, plane, Signals())
        meet(plane)
        assert not plane.coordinator_gone()
        first.close()
        wait_for(plane.coordinator_gone)
        assert not plane.coordinator_gone(for_s=3600)
        admission = pool.submit(process.request_admission)  # waits for the coordinator
        second = Coordinator(ticket)
        while not admission.done():
            second.poll()
        admission.result()
        wait_for(lambda: not plane.coordinator_gone())
        second.close()
        wait_for(lambda: plane.coordinator_gone(for_s=0.2))
        assert not plane.coordinator_gone(for_s=3600)
