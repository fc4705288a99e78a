"""Live control of real emulators, end to end."""

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from netem.control import emulator_commands
from netem.control.emulator_session import running
from noack.core.errors import ExitStatus
from tests.netem.control.processes import emulator, read_until, send_through, udp_socket


def shown(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The statistics of the only emulator that runs."""
    capsys.readouterr()
    assert emulator_commands.main(["show", "--json"]) == ExitStatus.OK
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    return document


@pytest.mark.parametrize("engine", ["auto", "plain"])
def test_a_cap_set_while_it_runs_is_kept(engine: str, capsys: pytest.CaptureFixture[str]) -> None:
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
        assert (found["arrived"], found["forwarded"]) == (320, 120)
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


def test_statistics_are_lines_of_json(tmp_path: Path) -> None:
    file = tmp_path / "statistics.jsonl"
    options = ("--engine", "plain", "--stats", "0.05", "--stats-file", str(file), "loss", "100%")
    with (
        udp_socket() as server,
        emulator(server.getsockname(), *options) as (address, _),
    ):
        send_through(address, [b"x"] * 50)
        while file.read_text().count("\n") < 5:
            time.sleep(0.01)
    documents = [json.loads(line) for line in file.read_text().splitlines()]
    arrived = [document["links"][0]["forward"]["arrived"] for document in documents]
    assert arrived == sorted(arrived)
    assert arrived[-1] == 50
    elapsed = [document["elapsed_s"] for document in documents]
    assert elapsed == sorted(elapsed)
    assert documents[0]["links"][0]["forward"]["recent"] is None
    assert all(document["links"][0]["forward"]["recent"] for document in documents[1:])


def test_a_reader_that_leaves_does_not_stop_the_relay() -> None:
    with (
        udp_socket() as server,
        emulator(server.getsockname(), "--engine", "plain", "--stats", "0.02") as (
            address,
            process,
        ),
    ):
        assert process.stdout is not None
        assert process.stderr is not None
        assert json.loads(process.stdout.readline())["links"][0]["name"] == "relay"
        process.stdout.close()
        error = read_until(process.stderr.fileno(), lambda text: text.endswith("continues\n"))
        assert error.splitlines()[-1] == (
            "noack netem: statistics cannot be written to standard output "
            "(Broken pipe); the relay continues"
        )
        send_through(address, [b"still here"])
        assert server.recv(100) == b"still here"


PAYLOADS = [number.to_bytes(2) * 20 for number in range(150)]


def run_through(
    capsys: pytest.CaptureFixture[str], *options: str, payloads: Sequence[bytes] = PAYLOADS
) -> list[bytes]:
    """Send payloads through an emulator; return what comes out."""
    with (
        udp_socket() as server,
        emulator(server.getsockname(), "--control", "lab", *options) as (address, _),
    ):
        send_through(address, payloads)
        while True:
            found = shown(capsys)["links"][0]["forward"]
            if found["arrived"] == len(payloads) and found["in_flight"] == 0:
                return [server.recv(100) for _ in range(found["forwarded"])]


WORDS = ("loss", "gemodel", "10%", "30%", "duplicate", "20%", "corrupt", "20%")


@pytest.mark.parametrize("engine", ["auto", "plain"])
def test_a_recorded_run_is_repeated_exactly(
    tmp_path: Path, engine: str, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = str(tmp_path / "fates.parquet")
    before = run_through(capsys, "--engine", engine, "--record-fates", trace, *WORDS, "mansd", "2")
    again = run_through(
        capsys, "--engine", engine, "--replay-fates", trace, "--seed", "99", *WORDS, "mansd", "2"
    )
    assert again == before
    assert len({*before} - {*PAYLOADS}) > 15
    other = run_through(capsys, "--engine", engine, "--seed", "99", *WORDS, "mansd", "2")
    assert other != before


def test_a_recorded_run_with_delays_is_repeated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the order in which delays that overlap by chance let it."""
    trace = str(tmp_path / "fates.parquet")
    before = run_through(capsys, "--record-fates", trace, *WORDS, "delay", "3ms", "2ms")
    again = run_through(capsys, "--replay-fates", trace, "loss", "100%")
    assert Counter(again) == Counter(before)


def test_a_replay_keeps_the_cap_of_its_record_unless_told_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trace = str(tmp_path / "fates.parquet")
    first = run_through(capsys, "--record-fates", trace, "loss", "60%", "mansd", "2")
    for words, period in (("loss 100%", 3), ("loss 100% mansd 4", 5)):
        again = run_through(
            capsys, "--replay-fates", trace, *words.split(), payloads=[*PAYLOADS, *PAYLOADS]
        )
        beyond = [PAYLOADS.index(payload) for payload in again[len(first) :]]
        assert again[: len(first)] == first
        assert set(np.diff(beyond)) == {period}


def test_a_trace_of_other_links_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "links.toml"
    file.write_text('[[link]]\nname = "up"\nlisten = ":0"\nto = "127.0.0.1:9"\n')
    trace = str(tmp_path / "fates.parquet")
    run_through(capsys, "--engine", "plain", "--record-fates", trace)
    done = subprocess.run(
        [sys.executable, "-m", "netem", "--links", str(file), "--replay-fates", trace],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == ExitStatus.CALLER
    assert done.stderr == (f"noack netem: {trace}: has no link 'up'; its links: relay\n")
