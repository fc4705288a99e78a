"""The loop across two hosts: network namespaces that a veth link connects."""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from benchmarks.programs import set_options
from benchmarks.report import Goal, MeasurementError, Row, benchmark
from benchmarks.rounds import Figures, Rounds
from tests.helpers.run_by_hand import RunByHand
from tests.helpers.two_hosts import TwoHosts, two_hosts

ROUNDS = 3
ACROSS, ON_LOOPBACK = "noack across a veth link", "noack on loopback"
_CHANGES = ("horizon_s=10", "trigger.beta=1e-9", 'network.loss={model="lossless"}')


def run_by_hand(hosts: TwoHosts | None) -> Figures:
    """Return the latency of a run with the controller on the second host, or all on this one."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        run = RunByHand(stack, Path(folder), hosts, *set_options(*_CHANGES)).finish()
    if run.status:
        raise MeasurementError(run.stderr.strip().splitlines()[-1])
    latency_us = run.summary["loops"][0]["latency_us"]
    return {key: latency_us[key] for key in ("p50", "p99", "updates")}


@benchmark("hosts", "The loop across two hosts")
def across_hosts() -> Iterator[Row]:
    """Compare the loop with the controller on the second host with the same processes on loopback."""
    rounds = Rounds()
    with two_hosts() as hosts:
        sides = {ON_LOOPBACK: partial(run_by_hand, None), ACROSS: partial(run_by_hand, hosts)}
        rounds.measure_in_turn(ROUNDS, sides)
    note = f"{sum(rounds.values(ACROSS, 'updates')):.0f} updates"
    for quantile in ("p50", "p99"):
        name, goal = f"event → update, {quantile}", Goal("<=", 1.5)
        yield rounds.row(name, "µs", quantile, ACROSS, ON_LOOPBACK, goal, note=note, paired=True)
