"""A shell (``netem shell``) beside a bare forwarder in C: throughput of TCP, and round-trip time."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial

from benchmarks.programs import compile_program, program_path
from benchmarks.report import Goal, MeasurementError, Row, benchmark
from benchmarks.rounds import Figures, Rounds
from netem.relay.relay_links import LinkSpec
from netem.shell.devices import inside, open_devices
from noack.impairments.link_settings import LinkSettings

_ROUNDS = 5
_PINGS = 500
_THROUGHPUT_S = 3
_PORT = 5209
_SHELL, _BARE_FORWARDER = "noack netem shell", "bare forwarder in C"


def _run_beside_forwarder(command: str) -> str:
    link = open_devices(LinkSpec("bare", ("", 0), ("", 0), LinkSettings(), LinkSettings()))
    with ExitStack() as stack:
        stack.callback(link.close)
        words = [compile_program("tun.c"), *map(str, link.devices)]
        process = stack.enter_context(subprocess.Popen(words, pass_fds=link.devices))
        stack.callback(process.kill)
        with inside(link):
            variables = os.environ | {"TO": link.spec.to[0]}
            words = ["sh", "-c", command]
            inner = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=variables)
        return inner.communicate()[0]


def _run_in_shell(command: str) -> str:
    words = [sys.executable, "-m", "netem", "shell", "--", "sh", "-c", f"TO=$NOACK_OUTSIDE; {command}"]
    return subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True).stdout


def _shell_figures(run: Callable[[str], str]) -> Figures:
    """Measure with ``run``, which runs a command line of sh inside, where ``$TO`` is the outside."""
    try:
        end = json.loads(run(f"iperf3 -J -c $TO -p {_PORT} -t {_THROUGHPUT_S}"))["end"]
        pings = run(f"ping -q -i 0.002 -c {_PINGS} $TO")
        (trip_ms,) = re.findall(r"= [\d.]+/([\d.]+)/", pings)
        return {"mbit": end["sum_received"]["bits_per_second"] / 1e6, "us": 1e3 * float(trip_ms)}
    except (ValueError, KeyError):
        raise MeasurementError("its programs did not report") from None


@benchmark("shell", "A shell: throughput of TCP, and time to the outside and back")
def shell() -> Iterator[Row]:
    """Measure a shell without impairments, in turn with the alternative, which needs root."""
    server = [program_path("iperf3", "iperf3"), "-s", "-p", str(_PORT)]
    rounds = Rounds()
    with subprocess.Popen(server, stdout=subprocess.DEVNULL) as process, ExitStack() as stack:
        stack.callback(process.kill)
        sides = {
            _BARE_FORWARDER: partial(_shell_figures, _run_beside_forwarder),
            _SHELL: partial(_shell_figures, _run_in_shell),
        }
        rounds.measure_in_turn(_ROUNDS, sides)
    row = partial(rounds.row, ours=_SHELL, peer=_BARE_FORWARDER, paired=True)
    yield row("TCP", "Mbit/s", "mbit", goal=Goal(">=", 0.9))
    yield row("ping, mean", "µs", "us")
