"""End-to-end tests: control real emulators while they run."""

import json
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from netem.cli import relay_run
from netem.control import emulator_commands
from netem.control.emulator_session import running
from netem.fates.fate_recorder import FateRecorder
from netem.words.words_to_settings import settings_of
from noack.core.errors import ExitStatus
from tests.netem.control.processes import emulator, send_through, udp_socket
from tests.netem.fates.links import spec_of


def shown(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Return the statistics of the only running emulator."""
    capsys.readouterr()
    assert emulator_commands.main(["show", "--json"]) == ExitStatus.OK
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    return document


@pytest.mark.parametrize("engine", ["auto", "plain"])
def test_a_cap_set_at_runtime_is_kept(engine: str, capsys: pytest.CaptureFixture[str]) -> None:
    sent = [number.to_bytes(2) for number in range(320)]
    with (
        udp_socket() as server,
        emulator(server.getsockname(), "--control", "lab", "--engine", engine) as (address, _),
        udp_socket(address) as client,
    ):
        assert running() == ["lab"]
        for payload in sent[:20]:
            client.send(payload)
        assert [server.recv(10) for _ in range(20)] == sent[:20]

        assert emulator_commands.main(["set", "loss", "100%", "mansd 2"]) == ExitStatus.OK
        assert "forward: loss 100% mansd 2\n" in capsys.readouterr().out
        for payload in sent[20:]:
            client.send(payload)
        received = [int.from_bytes(server.recv(10)) for _ in range(100)]
        assert received == list(range(22, 320, 3))

        found = shown(capsys)["links"][0]["forward"]
        assert (found["received"], found["forwarded"]) == (320, 120)
        assert found["fates"] | {"delivered": 0} == {
            "delivered": 0, "dropped": 200, "forced": 100, "corrupted": 0, "overflowed": 0,
            "blacked_out": 0,
        }  # fmt: skip
        assert (found["longest_loss_burst"], found["mansd"]) == (2, 2)
        assert found["loss"]["realised"] == pytest.approx(2 / 3)
        assert found["loss"]["predicted"] == pytest.approx(2 / 3)
        assert sum(found["unintended"].values()) == 0
        assert [flow["packets"] for flow in found["flows"]] == [320]

        assert emulator_commands.main(["set", "lab", "loss 5%"]) == ExitStatus.OK
        assert capsys.readouterr().err == (
            "noack netem set: relay forward has no cap now; the words replaced "
            "all settings, mansd 2 too\n"
        )

        before = shown(capsys)["links"][0]["forward"]["words"]
        assert (
            emulator_commands.main(["set", "lab", "--direction", "reverse", "lozz 5%"])
            == ExitStatus.CALLER
        )
        error = capsys.readouterr().err
        assert error.startswith("noack netem set: lozz: ")
        assert error.count("\n") == 1
        assert shown(capsys)["links"][0]["forward"]["words"] == before
    assert running() == []


def test_a_killed_emulator_is_not_found(capsys: pytest.CaptureFixture[str]) -> None:
    with udp_socket() as server:
        options = ("--control", "lab", "--engine", "plain")
        with emulator(server.getsockname(), *options, status=-signal.SIGKILL) as (_, process):
            process.kill()
    assert emulator_commands.main(["show", "lab"]) == ExitStatus.CALLER
    assert "no emulator 'lab' accepts commands" in capsys.readouterr().err


PAYLOADS = [number.to_bytes(2) * 20 for number in range(150)]


def run_through(
    capsys: pytest.CaptureFixture[str], *options: str, payloads: Sequence[bytes] = PAYLOADS
) -> list[bytes]:
    """Send payloads through an emulator; return the received datagrams."""
    with (
        udp_socket() as server,
        emulator(server.getsockname(), "--control", "lab", *options) as (address, _),
    ):
        send_through(address, payloads)
        while True:
            found = shown(capsys)["links"][0]["forward"]
            if found["received"] == len(payloads) and found["in_flight"] == 0:
                return [server.recv(100) for _ in range(found["forwarded"])]


WORDS = ("loss", "gemodel", "10%", "30%", "duplicate", "20%", "corrupt", "20%")


def test_a_recorded_run_is_replayed_exactly(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = str(tmp_path / "fates.parquet")
    before = run_through(capsys, "--record-fates", trace, *WORDS, "mansd", "2")
    again = run_through(capsys, "--replay-fates", trace, "--seed", "99", *WORDS)
    assert again == before
    assert len({*before} - {*PAYLOADS}) > 15


@pytest.mark.parametrize(("words", "cap"), [("loss 100%", 2), ("loss 100% mansd 4", 4)])
def test_a_replay_uses_the_cap_of_its_trace_by_default(
    tmp_path: Path, words: str, cap: int
) -> None:
    path = tmp_path / "fates.parquet"
    with FateRecorder(path, [spec_of(settings_of("loss 60% mansd 2"), "relay")]):
        pass
    (spec,) = relay_run._replaying([spec_of(settings_of(words), "relay")], path)
    assert (spec.forward.mansd, spec.reverse.mansd) == (cap, None)
    assert spec.decisions == {"forward": [], "reverse": []}
