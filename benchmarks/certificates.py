"""Every kind of certificate against random loops: no bound is exceeded, and broken copies are.

The loops are simulated without any code of noack, in two processes. A kind of certificate is one
entry of ``KINDS``; :mod:`benchmarks._certificate_kinds` says what it consists of.
"""

import argparse
from collections import Counter
from collections.abc import Mapping
from functools import reduce

import numpy as np

from benchmarks._certificate_kinds import Broken, Kind, Tally
from benchmarks._certificate_kinds.continuous import CONTINUOUS
from benchmarks._certificate_kinds.decaying import DECAYING
from benchmarks._certificate_kinds.disturbed import DISTURBED
from benchmarks._certificate_kinds.known_state import KNOWN_STATE
from benchmarks._certificate_kinds.observed import OBSERVED
from benchmarks._certificate_kinds.policies import POLICIES
from benchmarks._certificate_kinds.random_losses import RANDOM_LOSSES
from benchmarks._report import Benchmark, Goal, Row, say
from cosim.live.process_pool import interrupts_held, processes

KINDS: Mapping[str, Kind] = {
    kind.name: kind
    for kind in (
        DECAYING,
        CONTINUOUS,
        DISTURBED,
        OBSERVED,
        RANDOM_LOSSES,
        KNOWN_STATE,
        *POLICIES,
    )
}

ROUNDING = 1 + 1e-9
_CHUNK = 20
_WORKERS = 2
_BROKEN_SHARE = 10
"""Each broken copy is given this fraction, 1/10, of the number of loops."""


def examine(kind: Kind, seeds: range, broken: Broken | None = None) -> Tally:
    """Simulate one certified loop for each seed, and compare with the bounds."""
    certify = kind.certify if broken is None else broken.certify
    draw = (None if broken is None else broken.draw) or kind.draw
    runs, violated, closest, refused = 0, Counter[str](), Counter[str](), 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        loop = draw(rng)
        while (bounds := certify(loop)) is None:
            loop, refused = draw(rng), refused + 1
        observed = kind.simulate(loop, rng)
        runs += observed.runs
        for name, bound in bounds.items():
            share = observed.worst[name] / bound
            closest[name] = max(closest[name], share)
            violated[name] += share > ROUNDING
        violated[""] += any(observed.worst[name] > ROUNDING * bounds[name] for name in bounds)
    return Tally(len(seeds), runs, refused, violated, closest)


def examine_all(loops: int, kinds: Mapping[str, Kind] = KINDS, first: int = 0) -> list[Row]:
    """Return the rows of every kind, from this number of loops each, with seeds from ``first``."""
    rows = []
    with processes(_WORKERS) as pool:
        for kind in kinds.values():
            for name, broken in ({"": None} | dict(kind.broken)).items():
                say(f"{kind.name}{f', broken copy: {name}' if name else ''}")
                part = 1 if broken is None else _BROKEN_SHARE
                begin, count = first // part, max(loops // part, 1)
                seeds = range(begin, begin + count)
                chunks = [seeds[at : at + _CHUNK] for at in range(0, count, _CHUNK)]
                with interrupts_held():
                    parts = [pool.submit(_examine_chunk, kind.name, name, one) for one in chunks]
                found = reduce(Tally.plus, (part.result() for part in parts))
                rows.append(_row(kind, name, found))
    return rows


def _examine_chunk(name: str, broken: str, seeds: range) -> Tally:
    kind = KINDS[name]
    return examine(kind, seeds, kind.broken[broken] if broken else None)


def _row(kind: Kind, broken: str, found: Tally) -> Row:
    violated = found.violated[""]
    if broken:
        share = 100 * violated / found.loops
        return Row(
            f"{kind.name}, broken copy: {broken}",
            share,
            f"% of {found.loops} loops",
            goal=Goal(">=", 1e-9),
        )
    closest = ", ".join(f"{name} {share:.3f}" for name, share in found.closest.items())
    return Row(
        f"{kind.name}: loops that exceed a bound", violated, f"of {found.loops}",
        goal=Goal("==", 0), note=f"{found.runs} runs; {found.refused} more loops not certified; "
        f"worst/certified: {closest}",
    )  # fmt: skip


def measure(options: argparse.Namespace) -> list[Row]:
    """Examine every kind, or the chosen one."""
    chosen = {name: KINDS[name] for name in options.kind or KINDS}
    return examine_all(options.loops, chosen, options.first)


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--loops", type=int, default=200, help="certificates: loops per kind")
    parser.add_argument("--first", type=int, default=0, help="certificates: seed of the first loop")
    parser.add_argument(
        "--kind", action="append", choices=KINDS, help="certificates: only this kind"
    )


BENCHMARK = Benchmark("certificates", "Certificates of random loops", measure, _arguments)
