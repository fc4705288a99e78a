"""A run that is open to other hosts: its address, its credentials, and whom zenoh admits with them.

The sessions of zenoh are real, on loopback.
"""

import json
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from cosim.live.coordination import remote_access
from cosim.live.coordination.credentials_folder import MARK
from cosim.live.coordination.remote_access import ListenSettings, credentials
from netem.core.errors import CallerError, MachineError, NoAnswerError, PeerError
from noack.protocol.roles import COORDINATOR, LOOP_ROLES, RECORDER
from noack.runtime.active_runs import run_name
from noack.runtime.connections import zenoh_session
from noack.runtime.connections.credentials import read_credentials
from noack.runtime.control_messages import JoinRequest
from noack.runtime.control_plane import ControlPlane
from noack.runtime.run_descriptor import RunDescriptor
from noack.scenario.run_sections import ClocksSection
from tests.helpers.approved import compare_lines
from tests.helpers.run_descriptors import RUN_DESCRIPTOR
from tests.helpers.waiting import wait_for


def test_a_run_listens_at_addresses_that_others_can_reach() -> None:
    """A port may be missing."""

    def addresses(text: str) -> list[str]:
        try:
            return ["{} port {}".format(*remote_access.listen_address(json.loads(text)))]
        except CallerError as error:
            return [str(error).partition(" (")[0]]

    compare_lines(Path(__file__).with_name("addresses.txt"), addresses)


def test_the_clock_of_the_recording_host_may_be_off_by_as_much_as_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    strict = ClocksSection(largest_error_us=5.0)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert remote_access.own_clock(strict).error_ns == 5000  # as stated
    chronyc = tmp_path / "chronyc"
    chronyc.write_text("#!/bin/sh\necho 0,,1,0,0.000006,0,0,0,0,0,0,0,8,Normal\n")
    chronyc.chmod(0o755)
    with pytest.raises(
        PeerError, match=r"the clock of this host may be off by 6 µs, as `chronyc tracking` says; "
    ):
        remote_access.own_clock(strict)
    chronyc.write_text("#!/bin/sh\necho 0,,1,0,0.000006,0,0,0,0,0,0,0,8,Not synchronised\n")
    with pytest.raises(MachineError, match="chrony has not synchronised"):
        remote_access.own_clock(strict)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def settings(tmp_path: Path) -> ListenSettings:
    return ListenSettings(("127.0.0.1", free_port()), tmp_path / "credentials")


def test_a_taken_address_and_one_of_another_host_are_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(CallerError, match=r"cannot listen on 127\.0\.0\.1:\d+: Address already in use"):
            remote_access.require_free(taken.getsockname())
    with pytest.raises(CallerError, match=r"cannot listen on 192\.0\.2\.1:7447: Cannot assign"):
        remote_access.require_free(("192.0.2.1", 7447))


# --- the folder -----------------------------------------------------------------------------------


def test_the_folder_has_the_credentials_of_each_role(settings: ListenSettings, tmp_path: Path) -> None:
    folder = settings.folder
    with credentials(settings, RUN_DESCRIPTOR, RUN_DESCRIPTOR.scenario) as own:
        assert own.credentials == str(folder / RECORDER)
        assert {path.name for path in folder.iterdir()} == {RECORDER, *LOOP_ROLES, MARK}
        keys = [path.read_bytes() for path in folder.rglob("private_key.pem")]
        assert len({*keys}) == 5
        descriptor = read_credentials(folder / "sensor", "sensor", tmp_path / "kept")
        assert descriptor.remote == settings.address
        assert descriptor.host == "127.0.0.1"
        assert descriptor.run_dir == str(tmp_path / "kept" / "run")
        assert descriptor.key == RUN_DESCRIPTOR.key
        assert not descriptor.launched
        authority = (folder / "sensor" / "ca.pem").read_bytes()
    assert not folder.exists()
    with credentials(settings, RUN_DESCRIPTOR, RUN_DESCRIPTOR.scenario):
        assert (folder / "sensor" / "ca.pem").read_bytes() != authority


def test_a_folder_that_cannot_be_written_is_named(settings: ListenSettings) -> None:
    elsewhere = settings._replace(folder=settings.folder / "no" / "folder")
    with pytest.raises(CallerError, match="credentials cannot be written: No such file or directory"):
        credentials(elsewhere, RUN_DESCRIPTOR, RUN_DESCRIPTOR.scenario).__enter__()


# --- who is admitted ------------------------------------------------------------------------------


@pytest.fixture
def run(
    settings: ListenSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[ControlPlane, Path]]:
    """The coordinator's end of a control plane, which answers all requests; its folder of credentials."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(zenoh_session, "_CONNECT_MS", 1500)  # after which a connection has failed
    with (
        credentials(settings, RUN_DESCRIPTOR, RUN_DESCRIPTOR.scenario) as own,
        ControlPlane(own, COORDINATOR, listen=True) as plane,
    ):

        def answer(query: zenoh.Query) -> None:
            plane.answer(query, {"to": str(query.key_expr)})

        for request in ("admit", "join", "report"):
            plane.session.declare_queryable(plane.key(request, "*"), answer)
        yield plane, settings.folder


def remote(folder: Path, role: str, tmp_path: Path) -> RunDescriptor:
    return read_credentials(folder / role, role, tmp_path / "kept")


def ask(plane: ControlPlane) -> bytes:
    return plane.request("admit", JoinRequest(instance="one", address=None), timeout_s=10.0)


def test_a_process_with_credentials_is_admitted(run: tuple[ControlPlane, Path], tmp_path: Path) -> None:
    coordinator, folder = run
    with ControlPlane(remote(folder, "sensor", tmp_path), "sensor") as plane:
        assert b"admit/sensor" in ask(plane)
        assert not plane.coordinator_gone()
        coordinator.request_stop("enough")
        wait_for(lambda: plane.stop_requested() == "enough")
    with ControlPlane(RUN_DESCRIPTOR, "controller") as plane:  # of this host
        assert b"admit/controller" in ask(plane)


def test_the_certificate_of_another_role_permits_nothing_of_this_role(
    run: tuple[ControlPlane, Path], tmp_path: Path
) -> None:
    """The sensor's certificates, with a run descriptor that says controller: a thief of the first."""
    coordinator, folder = run
    received: list[str] = []
    every = f"noack/{run_name(RUN_DESCRIPTOR.run_id)}/**"
    coordinator.session.declare_subscriber(every, lambda sample: received.append(str(sample.key_expr)))
    with pytest.raises(CallerError, match="these credentials are of sensor, not of controller"):
        read_credentials(folder / "sensor", "controller", tmp_path)
    stolen = remote(folder, "sensor", tmp_path)
    with ControlPlane(stolen, "controller") as thief:
        with pytest.raises(NoAnswerError):
            thief.request("admit", JoinRequest(instance="one", address=None), timeout_s=2.0)
        thief.request_stop("I say so")
        thief.announce_done()
        thief.publish_telemetry("controller_step", b"{}", b"rows")
        thief.role = "sensor"
        thief.announce_done()
        wait_for(lambda: bool(received))
    assert [key.rpartition("/")[2] for key in received] == ["sensor"]


@pytest.mark.parametrize("which", ["another run", "none", "another role's key"])
def test_the_certificates_of_a_third_party_are_refused(
    run: tuple[ControlPlane, Path], settings: ListenSettings, tmp_path: Path, which: str
) -> None:
    _, folder = run
    mine = tmp_path / "mine"
    shutil.copytree(folder / "sensor", mine)
    with credentials(settings._replace(folder=tmp_path / "third"), RUN_DESCRIPTOR, RUN_DESCRIPTOR.scenario):
        if which == "another run":
            for name in ("certificate.pem", "private_key.pem"):
                shutil.copy(tmp_path / "third" / "sensor" / name, mine / name)
        elif which == "none":
            for name in ("certificate.pem", "private_key.pem"):
                (mine / name).write_bytes(b"")
        else:
            shutil.copy(folder / "plant" / "private_key.pem", mine / "private_key.pem")
    descriptor = read_credentials(mine, "sensor", tmp_path)
    with pytest.raises(NoAnswerError, match=r"cannot reach the run at 127\.0\.0\.1:\d+: "):
        ControlPlane(descriptor, "sensor")


def test_a_process_refuses_a_run_with_other_certificates(
    run: tuple[ControlPlane, Path], settings: ListenSettings, tmp_path: Path
) -> None:
    """Who listens in the place of the recording host is not believed."""
    with (
        credentials(settings._replace(folder=tmp_path / "third"), RUN_DESCRIPTOR, RUN_DESCRIPTOR.scenario),
        pytest.raises(
            NoAnswerError,
            match="a program listens there, but it is busy, or did not accept these credentials",
        ),
    ):
        ControlPlane(remote(tmp_path / "third", "sensor", tmp_path), "sensor")


def test_without_a_run_the_line_says_that_nothing_listens(
    settings: ListenSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("noack.runtime.connections.zenoh_session._CONNECT_MS", 200)
    with (
        credentials(settings, RUN_DESCRIPTOR, RUN_DESCRIPTOR.scenario),
        pytest.raises(NoAnswerError, match="nothing listens there; has `noack record` ended"),
    ):
        ControlPlane(remote(settings.folder, "sensor", tmp_path), "sensor")
