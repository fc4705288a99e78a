"""The bounds from the newest event, with and without disturbances and noise.

What is compared is the largest share of a bound, since it depends on time and on the losses.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks._certificate_kinds import Bounds, Broken, Kind, Observed
from benchmarks._certificate_kinds.decaying import search
from noack.theory.certificate_terms import VoidError
from noack.theory.kernel_bounds import NotDecayingError
from noack.theory.known_state import KnownStateBounds
from tests.noack.theory.disturbed_loops import DisturbedLoop, simulate_disturbed
from tests.noack.theory.known_state_loops import (
    BROKEN,
    KnownStateLoop,
    Mistake,
    random_known_state_loop,
)
from tests.noack.theory.loops import RUNS, simulate


@dataclass
class _Case:
    loop: KnownStateLoop
    found: KnownStateBounds | None = None


def _draw(rng: np.random.Generator, **fixed: object) -> _Case:
    return _Case(random_known_state_loop(rng, **fixed))


def _certified(mistake: Mistake, case: _Case) -> Bounds | None:
    try:
        case.found = mistake.bounds(case.loop.bounds())
    except (VoidError, NotDecayingError):
        return None
    case.loop = mistake.reading(case.loop)
    return dict.fromkeys(("x", "e_c"), 1.0)


def _simulate(case: _Case, rng: np.random.Generator) -> Observed:
    loop, found = case.loop, case.found
    assert found is not None
    if isinstance(loop.loop, DisturbedLoop):
        return Observed(RUNS, loop.shares(simulate_disturbed(loop.loop, rng), found))
    return search(loop.loop, rng, simulate, lambda _, trace: loop.shares(trace, found))


KNOWN_STATE = Kind(
    "known state", _draw, partial(_certified, Mistake()), _simulate,
    {
        name: Broken(partial(_certified, mistake), partial(_draw, **where))
        for name, (mistake, where) in BROKEN.items()
    },
)  # fmt: skip
