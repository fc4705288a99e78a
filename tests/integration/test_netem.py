"""The network emulator as a standalone program."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.netem.relay.relays import endpoints

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
