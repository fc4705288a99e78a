"""The control plane: who can reach it, and what arrives."""

import tempfile
import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, cast

import psutil
import pytest
import zenoh
from zenoh.handlers import FifoChannel

import noack.runtime.connections.zenoh_session
import noack.runtime.control_plane
import noack.runtime.join_run
from cosim.live.coordination.coordinator import Coordinator
from netem.core.command_line import Signals
from netem.core.errors import NoAnswerError, PeerError
from netem.core.private_folder import private_folder
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.active_runs import RUNS, run_name
from noack.runtime.connections.zenoh_session import cause_of, label
from noack.runtime.control_messages import RunStart, parse_message
from noack.runtime.control_plane import ControlPlane
from noack.runtime.join_run import _request_admission
from noack.runtime.run_descriptor import RunDescriptor, new_access, new_descriptor
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.scenario_file import validate
from tests.attacks.other_user import needs_root, output_of_another_user
from tests.fuzz.plane import FakePlane
from tests.helpers.waiting import wait_for


@pytest.fixture
def descriptor(content: dict[str, Any], tmp_path: Path) -> RunDescriptor:
    return new_descriptor(new_access(tmp_path, launched=True), resolve(validate(content, "")))


@pytest.fixture
def coordinator(descriptor: RunDescriptor) -> Iterator[Coordinator]:
    coordinator = Coordinator(descriptor, ResolvedRun(descriptor.scenario))
    yield coordinator
    coordinator.close()


def changed(descriptor: RunDescriptor, **update: Any) -> RunDescriptor:
    return descriptor.model_copy(update=update)


def test_a_message_that_arrives_under_another_key_is_ignored(
    coordinator: Coordinator, descriptor: RunDescriptor
) -> None:
    """zenoh once delivered a confirmation of rows as a request to stop."""
    with ControlPlane(descriptor, "plant") as plant:
        listener, sent_as = coordinator.plane, label(plant.key("persisted", "plant"))

        def arrives() -> bool:
            listener.acknowledge_rows("plant", {"rows": {}})
            return plant.next_persisted_ack() is not None

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


def test_the_coordinator_listens_on_no_port(descriptor: RunDescriptor) -> None:
    own = psutil.Process()
    before = set(own.net_connections("inet"))
    coordinator = Coordinator(descriptor, ResolvedRun(descriptor.scenario))
    assert set(own.net_connections("inet")) <= before
    coordinator.close()


REACH = """
import os, socket, sys
path = sys.argv[1]
for attempt in ("connect", "bind"):
    with socket.socket(socket.AF_UNIX) as endpoint:
        try:
            getattr(endpoint, attempt)(path + (".other" if attempt == "bind" else ""))
            print(attempt, "succeeded")
        except PermissionError:
            print(attempt, "refused")
try:
    os.unlink(path)
except PermissionError:
    print("unlink refused")
"""


@needs_root
def test_another_user_can_neither_connect_nor_listen(
    descriptor: RunDescriptor, monkeypatch: pytest.MonkeyPatch
) -> None:
    with tempfile.TemporaryDirectory() as short:
        Path(short).chmod(0o777)  # its users may come in, and make files
        monkeypatch.setenv("XDG_RUNTIME_DIR", short)
        coordinator = Coordinator(descriptor, ResolvedRun(descriptor.scenario))
        path = private_folder() / RUNS / f"{run_name(descriptor.run_id)}.sock"
        assert path.is_socket()
        output = output_of_another_user(REACH, str(path))
        assert output.splitlines() == ["connect refused", "bind refused", "unlink refused"]
        with ControlPlane(descriptor, "plant"):  # its user can
            pass
        coordinator.close()
        assert not path.exists()


def test_a_process_without_a_coordinator_says_so(
    descriptor: RunDescriptor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(noack.runtime.connections.zenoh_session, "_CONNECT_MS", 200)
    with pytest.raises(NoAnswerError, match=r"cannot reach the run's coordinator: (Unable|no connection)"):
        ControlPlane(descriptor, "plant")
    error = zenoh.ZError("Timeout! at /home/builder/.cargo/git/zenoh/orchestrator.rs:388.")
    assert cause_of(error) == "Timeout!"


def test_a_request_is_sent_again_when_its_answer_was_lost_and_its_answer_arrives_unchanged(
    coordinator: Coordinator, descriptor: RunDescriptor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(noack.runtime.control_plane, "_REQUEST_AGAIN_S", 0.2)
    answer = {
        "epoch_ns": 7,
        "epoch_realtime_ns": 8,
        "addresses": dict.fromkeys(LOOP_ROLES, ("127.0.0.1", 5)),
        "more": [1],
    }
    queries = coordinator.plane.session.declare_queryable(coordinator.plane.key("ask", "*"), FifoChannel(4))
    unanswered = []

    def serve() -> None:
        unanswered.append(queries.recv())
        with suppress(zenoh.ZError):  # the session is closed
            while True:  # on a machine that stalls, an answer may be too late
                ControlPlane.answer(queries.recv(), answer)

    threading.Thread(target=serve, daemon=True).start()
    with ControlPlane(descriptor, "plant") as plant:
        received = parse_message(RunStart, plant.request("ask", {}, timeout_s=30))
        assert received.epoch_ns == 7
        assert received.addresses == answer["addresses"]
        # The message must not read ``noack plant: plant: no answer``.
        with pytest.raises(PeerError, match=r"^the run did not answer the request 'nothing'"):
            plant.request("nothing", {}, timeout_s=0.05)
    unanswered.clear()


@pytest.mark.parametrize("launched", [True, False])
def test_a_launched_process_connects_again_until_it_is_admitted(
    descriptor: RunDescriptor, monkeypatch: pytest.MonkeyPatch, launched: bool
) -> None:
    """A connection without answers does not recover; started by a person, a process reports it."""
    tries: list[FakePlane] = []

    class Silent(FakePlane):
        def __init__(self, _descriptor: RunDescriptor, role: str) -> None:
            super().__init__()
            tries.append(self)
            if len(tries) == 1:
                raise NoAnswerError("cannot reach the run's coordinator")

        def request(self, what: str, *_: object, **__: object) -> bytes:
            if len(tries) < 3:
                raise NoAnswerError(f"no answer to {what!r}")
            return b"{}"

    monkeypatch.setattr(noack.runtime.join_run, "ControlPlane", Silent)
    monkeypatch.setattr(noack.runtime.join_run, "launcher_has_ended", lambda: False)
    asking = partial(_request_admission, "plant", changed(descriptor, launched=launched), Signals())
    if launched:
        assert asking().plane is cast(Any, tries[2])
        assert [attempt.is_closed for attempt in tries] == [False, True, False]
    else:
        with pytest.raises(NoAnswerError, match="cannot reach"):
            asking()
