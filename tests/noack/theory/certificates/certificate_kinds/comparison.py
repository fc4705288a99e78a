"""Every kind of certificate against random loops: no bound is exceeded, and broken copies are.

``python -m tests.noack.theory.certificates.certificate_kinds --loops 10000`` prints a line for each
kind and for each broken copy. The loops are simulated without any code of noack, in two processes.
"""

import argparse
from collections import Counter
from collections.abc import Mapping
from functools import reduce

import numpy as np

from cosim.live.processes.process_pool import process_starts, processes
from tests.noack.theory.certificates.certificate_kinds import Broken, Kind, Tally
from tests.noack.theory.certificates.certificate_kinds.continuous import CONTINUOUS
from tests.noack.theory.certificates.certificate_kinds.decaying import DECAYING
from tests.noack.theory.certificates.certificate_kinds.disturbed_policies import DISTURBED_POLICIES
from tests.noack.theory.certificates.certificate_kinds.margins import MARGINS
from tests.noack.theory.certificates.certificate_kinds.policies import POLICIES
from tests.noack.theory.certificates.certificate_kinds.regions import REGIONS
from tests.noack.theory.certificates.certificate_kinds.shares import DISTURBED, KNOWN_STATE, OBSERVED

KINDS: Mapping[str, Kind] = {
    kind.name: kind
    for kind in (
        DECAYING, CONTINUOUS, DISTURBED, OBSERVED, KNOWN_STATE,
        *POLICIES, *DISTURBED_POLICIES, MARGINS, REGIONS,
    )
}  # fmt: skip

_ROUNDING = 1 + 1e-9
_MOST_REFUSED = 1000
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
        first = refused
        while (bounds := certify(loop)) is None:
            loop, refused = draw(rng), refused + 1
            assert refused < first + _MOST_REFUSED, f"{kind.name}: no loop has a certificate"
        observed = kind.simulate(loop, rng)
        runs += observed.runs
        for name, bound in bounds.items():
            share = observed.worst[name] / bound
            closest[name] = max(closest[name], share)
            violated[name] += share > _ROUNDING
        violated[""] += any(observed.worst[name] > _ROUNDING * bounds[name] for name in bounds)
    return Tally(len(seeds), runs, refused, violated, closest)


def _examine_chunk(name: str, broken: str, seeds: range) -> Tally:
    kind = KINDS[name]
    return examine(kind, seeds, kind.broken[broken] if broken else None)


def _examine_all(kind: Kind, broken: str, loops: int, first: int) -> bool:
    """Examine loops with seeds from ``first``; print the result, and return whether it is right."""
    part = _BROKEN_SHARE if broken else 1
    begin, count = first // part, max(loops // part, 1)
    seeds = range(begin, begin + count)
    with processes(_WORKERS) as pool:
        with process_starts():
            parts = [
                pool.submit(_examine_chunk, kind.name, broken, seeds[at : at + _CHUNK])
                for at in range(0, count, _CHUNK)
            ]
        tally = reduce(Tally.plus, (part.result() for part in parts))
    violated = tally.violated[""]
    if broken:
        share = violated / tally.loops
        print(f"{kind.name}, broken copy: {broken}: caught in {share:.1%} of {tally.loops} loops")
        return violated > 0
    closest = ", ".join(f"{name} {share:.3f}" for name, share in tally.closest.items())
    print(
        f"{kind.name}: {violated} of {tally.loops} loops exceed a bound; {tally.runs} runs; "
        f"{tally.refused} more loops not certified; largest shares of a bound: {closest}"
    )
    return violated == 0


def main() -> int:
    """Examine every kind, or the chosen ones; return 1 if any result is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--loops", type=int, default=200, help="loops of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first loop")
    parser.add_argument("--kind", action="append", choices=KINDS, help="only this kind")
    options = parser.parse_args()
    right = [
        _examine_all(KINDS[name], broken, options.loops, options.first)
        for name in options.kind or KINDS
        for broken in ("", *KINDS[name].broken)
    ]
    return 0 if all(right) else 1
