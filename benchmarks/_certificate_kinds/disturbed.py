"""Disturbances and noise: the bounds of what decays and of what persists, added.

The disturbances switch at random, or have the sign for which a random output is largest at a random
time. A bound depends on time, so what is compared is the largest share of it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks._certificate_kinds import Bounds, Broken, Kind, Observed
from noack.theory.certificate_terms import VoidError
from noack.theory.kernel_bounds import NotDecayingError
from tests.noack.theory.disturbed_loops import (
    BROKEN,
    DisturbedLoop,
    Sum,
    random_disturbed_loop,
    simulate_disturbed,
)
from tests.noack.theory.loops import RUNS

_SIGNALS = ("e_s", "e_c", "x", "u − Kx", "δ")


@dataclass
class _Case:
    loop: DisturbedLoop
    found: Sum | None = None


def _draw(rng: np.random.Generator, **fixed: object) -> _Case:
    return _Case(random_disturbed_loop(rng, **fixed))


def _certified_by(certify: Callable[[DisturbedLoop], Sum]) -> Callable[[_Case], Bounds | None]:
    def bounds(case: _Case) -> Bounds | None:
        try:
            case.found = certify(case.loop)
        except (VoidError, NotDecayingError):
            return None
        return dict.fromkeys(_SIGNALS, 1.0)

    return bounds


def _simulate(case: _Case, rng: np.random.Generator) -> Observed:
    assert case.found is not None
    return Observed(RUNS, case.found.shares(simulate_disturbed(case.loop, rng)))


DISTURBED = Kind(
    "disturbed", _draw, _certified_by(DisturbedLoop.certify), _simulate,
    {
        name: Broken(_certified_by(certify), partial(_draw, **where))
        for name, (certify, where) in BROKEN.items()
    },
)  # fmt: skip
