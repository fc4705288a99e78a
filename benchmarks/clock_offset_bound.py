"""Bound of the offset between the clocks of two hosts, over an idle veth link.

The hosts are network namespaces with time namespaces: their monotonic clocks differ by a second,
exactly, and the client's has an added drift, so that the true offset is known at any time. The
programs request the real-time settings of a run. The alternative is a plain NTP exchange in Python:
the newest midpoint, without a bound, authentication or kernel timestamps.
"""

import argparse
import json
import subprocess
import sys
from typing import NamedTuple

from benchmarks._report import Benchmark, Figures, Goal, MeasurementError, Rounds, Row, say
from benchmarks._two_hosts import TwoHosts, two_hosts

OURS, BARE = "noack", "plain NTP midpoint, no bound"
SECONDS = 6.0
_DEFAULT_ERROR = Goal("<=", 50)


class Case(NamedTuple):
    """A setting of the client and of the reference, and the names of its figures."""

    name: str
    client: tuple[str, ...] = ()
    reference: tuple[str, ...] = ()
    goal: Goal | None = None


MAIN = Case("20 ms, replies read at once", goal=_DEFAULT_ERROR)
CASES = (
    Case("50 ms, replies read at once", ("--period-s", "0.05")),
    Case("50 ms, replies read 50 ms later", ("--period-s", "0.05", "--late")),
    Case(
        "50 ms, replies read 50 ms later, ρ = 201 ppm",
        ("--period-s", "0.05", "--late", "--rate-ppb", "201000"), goal=_DEFAULT_ERROR,
    ),
    Case("20 ms, reference answers every 50 ms", (), ("--answer-every-s", "0.05")),
)  # fmt: skip
CLOCKS = [(ahead_s, drift_ppb) for ahead_s in (1, -1) for drift_ppb in (100_000, -100_000)]
"""Seconds by which the client's clock is ahead, and its drift."""


def measured(
    hosts: TwoHosts, ahead_s: int, drift_ppb: int, case: Case, *, bare: bool = False,
    seconds: float = SECONDS, realtime: bool = True, ip: int = 4,
) -> Figures:  # fmt: skip
    """Run a reference and a client on two hosts; return the client's figures.

    Raises:
        MeasurementError: one of them failed.
    """
    program = (sys.executable, "-m", "benchmarks._time_peers")
    kind = ["--bare"] * bare + ["--realtime"] * realtime
    host = hosts.addresses[0][ip == 6]
    with subprocess.Popen(
        hosts.inside(0, *program, "reference", host, *kind, *case.reference),
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as reference:  # fmt: skip
        assert reference.stdout is not None
        port = reference.stdout.readline().strip()
        if not port:
            raise MeasurementError("the reference did not start")
        arguments = (
            port, host, f"--ahead-ns={-ahead_s * 10**9}", f"--drift-ppb={drift_ppb}",
            f"--seconds={seconds}", *kind, *case.client,
        )  # fmt: skip
        client = subprocess.run(
            hosts.inside(1, *program, "client", *arguments, monotonic_s=ahead_s),
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        reference.communicate()
    if client.returncode:
        raise MeasurementError(f"the client failed: {client.stderr.strip().splitlines()[-1:]}")
    found: Figures = json.loads(client.stdout)
    return found


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure both sides in turn with each clock, then the other settings."""
    rounds, others = Rounds(), {case: Rounds() for case in CASES}
    with two_hosts() as hosts:
        for ahead_s, drift_ppb in CLOCKS:
            say(f"client {ahead_s:+} s, {drift_ppb / 1000:+.0f} ppm")
            rounds.add(BARE, measured(hosts, ahead_s, drift_ppb, MAIN, bare=True))
            rounds.add(OURS, measured(hosts, ahead_s, drift_ppb, MAIN))
        for case, found in others.items():
            say(case.name)
            found.add(OURS, measured(hosts, *CLOCKS[0], case))
    every = [rounds, *others.values()]
    checks, outside = (
        sum(sum(one.of(OURS, name)) for one in every) for name in ("checks", "outside")
    )
    rows = [
        Row("checks of the bound against the true offset", checks, "", goal=Goal(">=", 1e5)),
        Row("true offset outside the bound", outside, "", goal=Goal("==", 0)),
    ]
    for case, found in ((MAIN, rounds), *others.items()):
        note = f"largest: {max(found.of(OURS, 'error_max_us')):.0f} µs"
        for q in ("p50", "p99"):
            name = f"error bound, {q}, {case.name}"
            rows.append(found.row(name, "µs", f"error_{q}_us", OURS, goal=case.goal, note=note))
    return rows + [
        rounds.row(name, "µs", quantity, OURS, BARE)
        for quantity, name in (
            ("estimate_p50_us", "error of the estimate, p50"),
            ("estimate_p99_us", "error of the estimate, p99"),
            ("cpu_us", "client's CPU per 20 ms"),
        )
    ]


BENCHMARK = Benchmark("clock_offset_bound", "Bound of the offset between two clocks", measure)
