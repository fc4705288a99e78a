"""Bounds that depend on time and on the losses: what is compared is the largest share of them.

``DISTURBED`` adds the bounds of what decays and of what persists; its disturbances switch at
random, or have the sign for which a random output is largest at a random time. ``OBSERVED`` has
Luenberger's observers, and Kalman filters from their start, with disturbances and noise; filter and
loop are simulated without noack. ``KNOWN_STATE`` has the bounds from the newest event.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.terms import NoCertificateError
from noack.theory.certificates.certified_bounds import KnownStateBounds, ScenarioCertificate
from tests.noack.theory import disturbed_loops, known_state_loops
from tests.noack.theory.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificate_kinds.decaying import search
from tests.noack.theory.disturbed_loops import DisturbedLoop, Sum, simulate_disturbed
from tests.noack.theory.known_state_loops import Mistake
from tests.noack.theory.loops import RUNS, simulate
from tests.noack.theory.observed_loops import ObservedLoop, random_observed_loop, worst_shares


@dataclass
class Case:
    """A loop, and what was certified of it last."""

    loop: Any
    found: Any = None


def drawn(draw: Callable[..., Any], where: dict[str, Any]) -> Callable[..., Case]:
    """Return what draws cases of loops with these settings."""
    return lambda rng: Case(draw(rng, **where))


def shares_of(
    names: Iterable[str], certify: Callable[[Case], Any]
) -> Callable[[Case], Bounds | None]:
    """Return what certifies a case; the bound of each share is 1."""
    names = tuple(names)

    def bounds(case: Case) -> Bounds | None:
        try:
            case.found = certify(case)
        except (NoCertificateError, NotDecayingError):
            return None
        return None if case.found is None else dict.fromkeys(names, 1.0)

    return bounds


def _simulate_disturbed(case: Case, rng: np.random.Generator) -> Observed:
    found: Sum = case.found
    return Observed(RUNS, found.shares(simulate_disturbed(case.loop, rng)))


def _disturbed_bounds(certify: Callable[[DisturbedLoop], Sum]) -> Callable[[Case], Bounds | None]:
    return shares_of(("e_s", "e_c", "x", "u − Kx", "δ"), lambda case: certify(case.loop))


DISTURBED = Kind(
    "disturbed", drawn(disturbed_loops.random_disturbed_loop, {}),
    _disturbed_bounds(DisturbedLoop.certify), _simulate_disturbed,
    {
        name: Broken(
            _disturbed_bounds(certify), drawn(disturbed_loops.random_disturbed_loop, where)
        )
        for name, (certify, where) in disturbed_loops.BROKEN.items()
    },
)  # fmt: skip


def _observed_bounds(change: Callable[[ObservedLoop], ObservedLoop]) -> Callable[..., Any]:
    def certified(case: Case) -> ScenarioCertificate | None:
        found = change(case.loop).certificate()
        return None if found.constants is None else found

    return shares_of(("e_s", "e_c", "x", "x̂ − x", "δ"), certified)


def _simulate_observed(case: Case, rng: np.random.Generator) -> Observed:
    return Observed(RUNS, worst_shares(case.loop, case.found, rng))


def _luenberger(change: Callable[[ObservedLoop], ObservedLoop], **where: Any) -> Broken:
    return Broken(_observed_bounds(change), drawn(random_observed_loop, {"kalman": False, **where}))


OBSERVED = Kind(
    "observed", drawn(random_observed_loop, {}), _observed_bounds(lambda loop: loop),
    _simulate_observed,
    {
        "no noise": _luenberger(
            lambda loop: replace(loop, noise=0.0), noise=0.1, push=0.02, beta=0.01
        ),
        "no disturbance": _luenberger(
            lambda loop: replace(loop, push=0.0), noise=0.01, push=0.3, beta=0.01
        ),
        "the plant is the model": _luenberger(
            lambda loop: replace(loop, A_model=loop.system.A, B_model=loop.system.B),
            noise=0.001, push=0.002, differs=0.3, known_start=True,
        ),
        "the first estimate is exact": _luenberger(
            lambda loop: replace(loop, system=replace(loop.system, known_start=True)),
            noise=0.01, push=0.02, known_start=False,
        ),
    },
)  # fmt: skip


def _known_state(mistake: Mistake, case: Case) -> KnownStateBounds:
    found = mistake.bounds(case.loop.bounds())
    case.loop = mistake.reading(case.loop)
    return found


def _simulate_known_state(case: Case, rng: np.random.Generator) -> Observed:
    loop, found = case.loop, case.found
    if isinstance(loop.loop, DisturbedLoop):
        return Observed(RUNS, loop.shares(simulate_disturbed(loop.loop, rng), found))
    return search(loop.loop, rng, simulate, lambda _, trace: loop.shares(trace, found))


def _known_state_bounds(mistake: Mistake) -> Callable[[Case], Bounds | None]:
    return shares_of(("x", "e_c"), partial(_known_state, mistake))


KNOWN_STATE = Kind(
    "known state", drawn(known_state_loops.random_known_state_loop, {}),
    _known_state_bounds(Mistake()), _simulate_known_state,
    {
        name: Broken(
            _known_state_bounds(mistake), drawn(known_state_loops.random_known_state_loop, where)
        )
        for name, (mistake, where) in known_state_loops.BROKEN.items()
    },
)  # fmt: skip
