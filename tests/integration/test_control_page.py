"""What docs/netem-control.md shows is run against real emulators: shell, curl, Prometheus's scrape."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from netem.control.http_server import LOOPBACK
from tests.helpers.pages import blocks
from tests.helpers.prometheus import of, parsed

pytestmark = pytest.mark.live

PAGE = "docs/netem-control.md"
PORT = "8475"
"""The port on the page."""


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Commands of this installation, and a runtime folder of their own."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return os.environ | {"PATH": path, "XDG_RUNTIME_DIR": str(tmp_path)}


def free_port() -> int:
    with socket.create_server((LOOPBACK, 0)) as free:
        return int(free.getsockname()[1])


@contextmanager
def emulator(command: str, environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Run an emulator as the page starts it, at free ports."""
    command = command.replace(":9000", ":0").replace(":9001", "127.0.0.1:9")
    with subprocess.Popen(
        f"exec {command}", shell=True, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("ready")
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)
            assert process.returncode == 0


def lines_of(block: str) -> list[str]:
    return [line.partition("  #")[0].strip() for line in block.splitlines()]


def run(line: str, assignments: list[str], environment: dict[str, str]) -> str:
    """Run a line of a shell in which variables were set before; return its output."""
    if line.startswith("noack netem watch"):
        with subprocess.Popen(f"exec {line}", shell=True, env=environment, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            text = process.stdout.readline().decode()
            process.send_signal(signal.SIGINT)
            process.communicate()
        assert process.returncode == 0
        return text
    script = "\n".join([*assignments, line.replace("curl ", "curl --silent --show-error --fail-with-body ")])
    done = subprocess.run(
        ["bash", "-euc", script], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{line}: {done.stdout}{done.stderr}"
    return done.stdout


def test_the_commands_of_the_page_run_in_their_order(environment: dict[str, str]) -> None:
    if shutil.which("curl") is None:
        pytest.skip("needs curl")
    port = str(free_port())
    script = [line for block in blocks(PAGE, "sh") for line in lines_of(block)]
    starts = [number for number, line in enumerate(script) if "--listen" in line]
    assert starts[0] == 0
    outputs: dict[str, str] = {}
    assignments: list[str] = []
    for start, end in zip(starts, [*starts[1:], len(script)], strict=True):
        with emulator(script[start].replace(PORT, port), environment):
            for line in script[start + 1 : end]:
                if re.match(r"\w+=", line):
                    assignments.append(line)
                else:
                    outputs[line] = run(line.replace(PORT, port), assignments, environment)
    assert len(outputs) == 12
    for line, text in outputs.items():
        if "/metrics" in line:
            assert of(parsed(text), "mansd_packets", link="relay", direction="forward") == 2
        elif "curl" in line:
            document = json.loads(text)
            assert ("links" in document) == ("/relay" not in line)
    (change,) = (text for line, text in outputs.items() if "loss 20% mansd 2" in line and "curl" in line)
    assert json.loads(change)["forward"]["words"] == "loss 20% mansd 2"


def test_prometheus_scrapes_as_the_page_says(environment: dict[str, str], tmp_path: Path) -> None:
    (text,) = blocks(PAGE, "yaml")
    (job,) = yaml.safe_load(text)["scrape_configs"]
    (static,) = job["static_configs"]
    (target,) = static["targets"]
    assert target == f"{LOOPBACK}:{PORT}"
    (start,) = [
        line for block in blocks(PAGE, "sh") for line in lines_of(block) if f"--control-port {PORT}" in line
    ]
    port = str(free_port())
    with emulator(start.replace(PORT, port), environment):
        file = Path(job["authorization"]["credentials_file"]).relative_to("/run/user/1000/noack-1000")
        token = (tmp_path / f"noack-{os.getuid()}" / file).read_text().strip()
        scrape = urllib.request.Request(
            f"http://{target.replace(PORT, port)}{job.get('metrics_path', '/metrics')}",
            headers={"Authorization": f"Bearer {token}"},
        )
        with urllib.request.urlopen(scrape, timeout=60) as answer:
            assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
            families = parsed(answer.read().decode())
    assert of(families, "received_packets_total", link="relay", direction="forward") == 0


def test_a_program_reads_the_addresses_and_a_killed_emulator_leaves_no_socket(
    environment: dict[str, str], tmp_path: Path
) -> None:
    words = ["--listen", ":0", "--to", ":9", "--control", "lab", "--control-port", "0", "--json"]
    with subprocess.Popen(
        [sys.executable, "-m", "netem", *words], env=environment, text=True, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        control = json.loads(process.stdout.readline())["control"]
        folder = Path(control["socket"]).parent
        assert {path.name for path in folder.iterdir()} == {"lab.json", "lab.sock", "lab.token"}
        assert control["url"].startswith(f"http://{LOOPBACK}:")
        assert control["token_file"] == str(folder / "lab.token")
        process.kill()
    show = [sys.executable, "-m", "netem", "show", "lab"]
    done = subprocess.run(show, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert "no emulator 'lab' accepts commands" in done.stderr
    assert list(folder.iterdir()) == []
