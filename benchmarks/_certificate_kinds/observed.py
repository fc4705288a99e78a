"""Observers: Luenberger's, and Kalman filters from their start, with disturbances and noise.

The certificate is that of a scenario; the filter and the loop are simulated without noack.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks._certificate_kinds import Bounds, Broken, Kind, Observed
from noack.theory.certified_bounds import ScenarioCertificate
from tests.noack.theory.loops import RUNS
from tests.noack.theory.observed_loops import ObservedLoop, random_observed_loop, worst_shares

_SIGNALS = ("e_s", "e_c", "x", "x̂ − x", "δ")


@dataclass
class _Case:
    loop: ObservedLoop
    found: ScenarioCertificate | None = None


def _draw(rng: np.random.Generator, **fixed: object) -> _Case:
    return _Case(random_observed_loop(rng, **fixed))


def _certified_as(
    change: Callable[[ObservedLoop], ObservedLoop],
) -> Callable[[_Case], Bounds | None]:
    def bounds(case: _Case) -> Bounds | None:
        case.found = change(case.loop).certificate()
        return None if case.found.constants is None else dict.fromkeys(_SIGNALS, 1.0)

    return bounds


def _simulate(case: _Case, rng: np.random.Generator) -> Observed:
    assert case.found is not None
    return Observed(RUNS, worst_shares(case.loop, case.found, rng))


_LUENBERGER = {"kalman": False}
OBSERVED = Kind(
    "observed", _draw, _certified_as(lambda loop: loop), _simulate,
    {
        "no noise": Broken(
            _certified_as(lambda loop: replace(loop, noise=0.0)),
            partial(_draw, noise=0.1, push=0.02, beta=0.01, **_LUENBERGER),
        ),
        "no disturbance": Broken(
            _certified_as(lambda loop: replace(loop, push=0.0)),
            partial(_draw, noise=0.01, push=0.3, beta=0.01, **_LUENBERGER),
        ),
        "the plant is the model": Broken(
            _certified_as(
                lambda loop: replace(loop, A_model=loop.system.A, B_model=loop.system.B)
            ),
            partial(_draw, noise=0.001, push=0.002, differs=0.3, known_start=True, **_LUENBERGER),
        ),
        "the first estimate is exact": Broken(
            _certified_as(
                lambda loop: replace(loop, system=replace(loop.system, known_start=True))
            ),
            partial(_draw, noise=0.01, push=0.02, known_start=False, **_LUENBERGER),
        ),
    },
)  # fmt: skip
