"""The network emulator as a standalone program, and its relay while it is stopped."""

import json
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from netem.control import emulator_commands
from netem.control.running_emulators import running_emulators
from netem.core.errors import ExitStatus
from netem.relay.relay import Relay
from tests.helpers.emulators import Emulate
from tests.netem.relay.relays import HOSTS, drain, endpoints, link, name_of

pytestmark = pytest.mark.live


def test_several_links_are_relayed_and_counted(tmp_path: Path) -> None:
    links, lines = tmp_path / "links.toml", tmp_path / "lines.json"
    with endpoints(*["127.0.0.1"] * 2) as (server, client):
        server.settimeout(60)
        address = "{}:{}".format(*server.getsockname())
        links.write_text(
            f"""
            [[link]]
            name = "first"
            listen = ":0"
            to = "{address}"
            words = "loss script 0"
            [[link]]
            name = "second"
            listen = ":0"
            to = "{address}"
            """
        )
        arguments = ["--links", str(links), "--realtime"]
        arguments += ["--stats", "0.05", "--stats-file", str(lines), "--json"]
        with subprocess.Popen(
            [sys.executable, "-m", "cosim.cli", "netem", *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        ) as process:  # fmt: skip
            assert process.stdout is not None
            ready = json.loads(process.stdout.readline())["ready"]
            ports = [int(link["listen"].rpartition(":")[2]) for link in ready]
            client.sendto(b"lost", ("127.0.0.1", ports[0]))
            client.sendto(b"passes", ("127.0.0.1", ports[1]))
            assert server.recv(100) == b"passes"
            client.sendto(b"second of the first", ("127.0.0.1", ports[0]))
            assert server.recv(100) == b"second of the first"
            process.send_signal(signal.SIGINT)
            _, stderr = process.communicate(timeout=60)
            assert process.returncode == 0, stderr
    newest = json.loads(lines.read_text().splitlines()[-1])["links"]
    assert [link["name"] for link in newest] == ["first", "second"]
    assert [link["forward"]["received"] for link in newest] == [2, 1]


def test_a_timetable_changes_a_running_emulator_again_and_again(emulate: Emulate, tmp_path: Path) -> None:
    """All is lost in every second 0.2 s."""
    (tmp_path / "tunnel.csv").write_text("time_s,words\n0,loss none\n0.2,loss 100%\n")
    with endpoints(*["127.0.0.1"] * 2) as (server, client):
        words = "--timetable", str(tmp_path / "tunnel.csv"), "--repeat", "400ms"
        emulator = emulate("{}:{}".format(*server.getsockname()), *words)
        passed, number, late_s = [0], 0, time.monotonic() + 60
        while len(passed) < 3 and time.monotonic() < late_s:  # runs of lost datagrams
            number += 1
            client.sendto(number.to_bytes(4, "big"), (emulator.host, emulator.port))
            time.sleep(0.002)
            for data, _ in drain(server):
                received = int.from_bytes(data, "big")
                if received - passed[-1] > 10:
                    passed.append(received)
                passed[-1] = received
        statistics = emulator.finish()["forward"]
    assert len(passed) == 3
    assert statistics["received_before"] > 0
    assert statistics["words"] in ("loss none", "loss 100%")
    assert statistics["fates"]["dropped"] >= 20


def test_a_cap_set_at_runtime_is_kept(emulate: Emulate, capsys: pytest.CaptureFixture[str]) -> None:
    sent = [number.to_bytes(2) for number in range(320)]
    with endpoints(*["127.0.0.1"] * 2) as (server, client):
        for endpoint in (server, client):
            endpoint.settimeout(60)
        emulator = emulate("{}:{}".format(*server.getsockname()), "--control", "lab")
        client.connect((emulator.host, emulator.port))
        assert running_emulators() == ["lab"]
        for payload in sent[:20]:
            client.send(payload)
        assert [server.recv(10) for _ in range(20)] == sent[:20]

        assert emulator_commands.main(["set", "loss", "100%", "mansd 2"]) == ExitStatus.OK
        assert "forward: loss 100% mansd 2\n" in capsys.readouterr().out
        for payload in sent[20:]:
            client.send(payload)
        received = [int.from_bytes(server.recv(10)) for _ in range(100)]
        assert received == list(range(22, 320, 3))

        assert emulator_commands.main(["show", "--json"]) == ExitStatus.OK
        totals = json.loads(capsys.readouterr().out)["links"][0]["forward"]
        assert (totals["received"], totals["forwarded"]) == (320, 120)
        assert (totals["fates"]["dropped"], totals["fates"]["forced"]) == (200, 100)
        assert (totals["longest_loss_burst"], totals["mansd"]) == (2, 2)
        assert totals["loss"]["realised"] == pytest.approx(2 / 3)
        assert totals["loss"]["predicted"] == pytest.approx(2 / 3)
        assert sum(totals["unintended"].values()) == 0
        assert [flow["packets"] for flow in totals["flows"]] == [320]

        assert emulator_commands.main(["set", "lab", "loss 5%"]) == ExitStatus.OK
        assert capsys.readouterr().err == (
            "noack-netem set: relay forward no longer has mansd 2; the words replaced all settings\n"
        )
        emulator.finish()
    assert running_emulators() == []


def test_datagrams_that_arrived_while_the_relay_was_stopped_come_before_housekeeping() -> None:
    """It is stopped for 60 ms while it waits for a pause, in which to do housekeeping that is due."""
    with (
        endpoints(HOSTS[4], HOSTS[4]) as (server, client),
        closing(Relay([link(name_of(server), return_path=False)])) as stopped,
    ):
        relay: Any = stopped
        relay._epoch_ns = time.monotonic_ns()
        to = relay.addresses()["test"]

        def stop() -> None:
            relay._memory.core.clock.epoch_ns -= 60_000_000
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)

        before = signal.signal(signal.SIGUSR1, lambda *_: client.sendto(b"waits", to))
        try:
            threading.Timer(0.003, stop).start()
            relay._relay_until(0)
        finally:
            signal.signal(signal.SIGUSR1, before)
        assert relay.report()[0].forward.counters.received == 1
