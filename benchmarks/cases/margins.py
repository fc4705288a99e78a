"""Random time-triggered loops: how many margins are decided, and how long that takes."""

import time
from collections import defaultdict
from collections.abc import Iterator
from statistics import median

from benchmarks.report import ZERO, Goal, Row, announce, benchmark
from tests.oracles.random_loops import random_loop


@benchmark("margins", "Random time-triggered loops: decided margins")
def margins(margin_loops: int = 200, first_margin_loop: int = 0) -> Iterator[Row]:
    """Bound the growth of random loops as ``noack margin`` does, and count what is undecided."""
    verdicts, times_s = defaultdict[str, list[str]](list), defaultdict[str, list[float]](list)
    for seed in range(first_margin_loop, first_margin_loop + margin_loops):
        loop = random_loop(seed)
        began_s = time.process_time()
        stability = loop.margin.stability(loop.guarantee)
        took_s = time.process_time() - began_s
        for kind in (loop.kind, "all"):
            verdicts[kind].append(stability.verdict)
            times_s[kind].append(took_s)
        bounds = f"{stability.lower:.6f} to {stability.upper:.6f}"
        text = f"growth {loop.growth:.6f}: {stability.verdict}, {bounds}, {took_s:.2f} s"
        announce(f"{seed}: {loop.kind}, {text}, {loop.guarantee.meaning}")
    for kind in (*sorted(verdicts.keys() - {"all"}), "all"):
        note = f"{len(verdicts[kind])} loops, worst {max(times_s[kind]):.1f} s"
        yield Row(f"{kind}: undecided", verdicts[kind].count("undecided"), "", goal=ZERO, note=note)
        yield Row(f"{kind}: CPU time, median", median(times_s[kind]), "s", goal=Goal("<=", 2.0))
