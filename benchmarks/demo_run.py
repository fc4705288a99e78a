"""The demo, as a user runs it: is every sample there, was nothing lost but by netem, was it in time?

Late is a plant step made more than one period after its time.
"""

import argparse
import sys

from benchmarks._report import Benchmark, Goal, Row, run, say
from benchmarks._runs import noack


def rows_of(summary: dict[str, object], late: dict[str, float]) -> list[Row]:
    """Return the rows of a demo run from its summary and its plant's lateness."""
    in_time = 100 * (1 - late["late_steps"] / late["steps"])
    return [
        Row("missing samples", _count(summary["missing_samples"]), "samples", goal=Goal("==", 0)),
        Row("lost outside netem", _count(summary["lost_outside_netem"]), "datagrams",
            goal=Goal("==", 0)),
        Row("plant steps within one period", in_time, "%", goal=Goal(">=", 99.9)),
        Row("plant lateness, p50", late["p50"], "µs"),
        Row("plant lateness, p99", late["p99"], "µs"),
        Row("plant lateness, max", late["max"], "µs"),
    ]  # fmt: skip


def _count(value: object) -> float:
    assert isinstance(value, int)
    return value


def measure(options: argparse.Namespace) -> list[Row]:
    """Run the demo once."""
    say("noack demo, 20 s")
    summary = noack("demo").summary
    return rows_of(summary, summary["lateness_us"]["plant"])


BENCHMARK = Benchmark("demo_run", "The demo's completeness and punctuality", measure)

if __name__ == "__main__":
    sys.exit(run([BENCHMARK]))
