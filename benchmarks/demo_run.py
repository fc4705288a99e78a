"""The demo, as a user runs it: missing samples, unintended losses, and late steps.

A plant step is late if it is made more than one period after its time.
"""

import argparse
from collections.abc import Mapping
from typing import Any

from benchmarks._report import Benchmark, Goal, Row, say
from benchmarks._runs import noack


def rows_of(summary: Mapping[str, Any]) -> list[Row]:
    """Return the rows of a demo run from its summary."""
    (loop,) = summary["loops"]
    late = loop["lateness_us"]["plant"]
    in_time = 100 * (1 - late["late_steps"] / late["steps"])
    nothing = Goal("==", 0)
    return [
        Row("missing samples", loop["missing_samples"], "samples", goal=nothing),
        Row(
            "lost outside netem",
            loop["unintended_losses"],
            "datagrams",
            goal=nothing,
        ),
        Row("plant steps within one period", in_time, "%", goal=Goal(">=", 99.9)),
        *(Row(f"plant lateness, {name}", late[name], "µs") for name in ("p50", "p99", "max")),
    ]


def measure(options: argparse.Namespace) -> list[Row]:
    """Run the demo once."""
    say("noack demo, 20 s")
    return rows_of(noack("demo").summary)


BENCHMARK = Benchmark("demo_run", "The demo's completeness and punctuality", measure)
