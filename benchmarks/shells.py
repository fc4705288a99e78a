"""The shell beside a bare forwarder between two devices, and beside mahimahi's shells."""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

from benchmarks.programs import compiled
from benchmarks.report import Goal, MeasurementError, Rounds, Row, benchmark
from netem.relay_links import LinkSpec
from netem.shell.devices import open_devices
from noack.impairments.link_settings import LinkSettings

_ROUNDS = 5
_PINGS = 500
_SECONDS = 3
_PORT = 5209
_NOACK, _BARE, _LOSS, _DELAY = "noack netem shell", "bare forwarder in C", "mm-loss", "mm-delay"
_SHELLS = {
    _NOACK: [sys.executable, "-m", "netem", "shell", "--"],
    _LOSS: ["mm-loss", "uplink", "0"],
    _DELAY: ["mm-delay", "0"],
}
Run = Callable[[str], str]
"""Runs a command line of sh inside, where ``$TO`` is the outside; returns its output."""


def _bare(command: str, forwarder: Path) -> str:
    link = open_devices(LinkSpec("bare", ("", 0), ("", 0), LinkSettings(), LinkSettings()))
    with ExitStack() as stack:
        stack.callback(link.close)
        words = [str(forwarder), *map(str, link.devices)]
        process = stack.enter_context(subprocess.Popen(words, pass_fds=link.devices))
        stack.callback(process.kill)
        with link.inside():
            variables = os.environ | {"TO": link.spec.to[0]}
            words = ["sh", "-c", command]
            inner = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=variables)
        return inner.communicate()[0]


def _in_shell(name: str, command: str) -> str:
    script = f"TO=${{NOACK_OUTSIDE:-$MAHIMAHI_BASE}}; {command}"
    words = [*_SHELLS[name], "sh", "-c", script]
    return subprocess.run(
        words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ).stdout


def _figures(run: Run) -> dict[str, float] | str:
    """Measure throughput from inside to outside, and the time to there and back."""
    try:
        end = json.loads(run(f"iperf3 -J -c $TO -p {_PORT} -t {_SECONDS}"))["end"]
        pings = run(f"ping -q -i 0.002 -c {_PINGS} $TO")
        (trip_ms,) = re.findall(r"= [\d.]+/([\d.]+)/", pings)
        return {"mbit": end["sum_received"]["bits_per_second"] / 1e6, "us": 1e3 * float(trip_ms)}
    except (ValueError, KeyError):
        return "its programs did not report"


@benchmark("shell", "A shell: throughput of TCP, and time to the outside and back")
def shell(_options: argparse.Namespace) -> Iterator[Row]:
    """Measure a shell without impairments, in turn with the alternatives; needs root for these."""
    if missing := [one for one in ("iperf3", "ping", "ip") if shutil.which(one) is None]:
        raise MeasurementError(f"there is no {', '.join(missing)}")
    rounds = Rounds()
    with tempfile.TemporaryDirectory(prefix="noack-bench-") as folder, ExitStack() as stack:
        forwarder = compiled("tun.c", Path(folder))
        server = ["iperf3", "-s", "-p", str(_PORT)]
        process = stack.enter_context(subprocess.Popen(server, stdout=subprocess.DEVNULL))
        stack.callback(process.kill)
        for _ in range(_ROUNDS):
            rounds.add(_BARE, _figures(lambda command: _bare(command, forwarder)))
            for name, words in _SHELLS.items():
                if shutil.which(words[0]) is None:
                    rounds.add(name, f"there is no {words[0]}")
                else:
                    rounds.add(name, _figures(lambda command, one=name: _in_shell(one, command)))
    for peer in (_BARE, _LOSS, _DELAY):
        goal = Goal(">=", 0.9) if peer == _BARE else None
        yield rounds.row("TCP", "Mbit/s", "mbit", _NOACK, peer, goal, paired=True)
        yield rounds.row("ping, mean", "µs", "us", _NOACK, peer, paired=True)
