"""All benchmarks, one table each: ``python -m benchmarks [--json FILE] [--install]``."""

import sys

from benchmarks import demo_run, latency, lateness, machines, simulation, startup
from benchmarks._report import run

if __name__ == "__main__":
    modules = (demo_run, latency, lateness, startup, machines, simulation)
    sys.exit(run([module.BENCHMARK for module in modules]))
