"""Benchmarks, one table each: ``python -m benchmarks [NAME ...] [--json FILE] [--install]``."""

import sys

from benchmarks import (
    batch,
    campaign,
    certificates,
    demo_run,
    emulator,
    flood,
    guarantee,
    guarantee_comparison,
    latency,
    lateness,
    long_run,
    loss_margins,
    machines,
    plants,
    recovery,
    relay_delay,
    relay_flows,
    relay_soak,
    relays,
    simulation,
    startup,
)
from benchmarks._programs import provide
from benchmarks._report import run

MODULES = (
    demo_run, emulator, flood, latency, lateness, startup, recovery, machines, plants, simulation,
    batch, campaign, long_run, relays, relay_delay, relay_flows, relay_soak,
    guarantee, guarantee_comparison, loss_margins, certificates,
)  # fmt: skip

if __name__ == "__main__":
    provide()
    sys.exit(run([module.BENCHMARK for module in MODULES]))
