"""Bounds that depend on time and on the losses: what is compared is the largest share of them.

``DISTURBED`` adds the bounds of what decays and of what persists; its disturbances switch at
random, or have the sign for which a random output is largest at a random time. ``OBSERVED`` has
Luenberger's observers, and Kalman filters from their start, with disturbances and noise; filter and
loop are simulated without noack. ``KNOWN_STATE`` has the bounds from the newest event; what is
known at it is read independently.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import expm

from noack.theory.bounds.certificate_terms import NoCertificateError
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.certificates.certified_bounds import KnownStateBounds, KnownStatePart, ScenarioCertificate
from tests.noack.theory.certificates import disturbed_loops
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certificate_kinds.decaying import search
from tests.noack.theory.certificates.certified_loops import certify_loop, conditions_of, gains_of
from tests.noack.theory.certificates.disturbed_loops import (
    DisturbedLoop,
    ObservedLoop,
    Sum,
    random_disturbed_loop,
    random_observed_loop,
    simulate_disturbed,
    worst_shares,
)
from tests.oracles.lossy_loops import (
    DRIFTING,
    RUNS,
    STEPS,
    Steps,
    System,
    Trace,
    Vector,
    random_system,
    simulate,
    times_s,
)

_NONE = 10**6
"""More missing events than any certificate allows."""


@dataclass(frozen=True)
class KnownStateLoop:
    """A loop with or without disturbances."""

    loop: System | DisturbedLoop

    @property
    def system(self) -> System:
        return self.loop.system if isinstance(self.loop, DisturbedLoop) else self.loop

    def bounds(self) -> KnownStateBounds:
        """The bounds; raises what the certificate raises."""
        system, delay_s = self.system, conditions_of(self.system).delay_s
        if not isinstance(self.loop, DisturbedLoop):
            part = KnownStatePart(gains_of(system), certify_loop(system), system.beta)
            return KnownStateBounds((part,), delay_s, np.zeros((len(system.A), 0)))
        parts = self.loop.certify()
        parts = (
            KnownStatePart(gains_of(system), parts.first, system.beta),
            KnownStatePart(self.loop.pushed(), parts.rest, 1.0),
        )
        return KnownStateBounds(parts, delay_s, self.loop.columns)

    def shares(self, trace: Trace, bounds: KnownStateBounds) -> dict[str, float]:
        """The largest shares of the bounds that runs reach."""
        system, step = self.system, np.arange(STEPS)
        last = np.maximum.accumulate(np.where(trace.is_event, step, -1), axis=1)
        run, at = np.nonzero(last >= 0)
        age, number = at - last[run, at], np.cumsum(trace.is_event, axis=1)
        missing = number - trace.received
        if not system.known_start:
            missing[trace.received == 0] = _NONE
        leap = expm((system.A + system.B @ system.K) * system.step_s)
        powers = [np.eye(len(leap))]
        for _ in range(STEPS):
            powers.append(leap @ powers[-1])
        predicted = np.einsum("kij,kj->ki", np.array(powers)[age], trace.known[run, last[run, at]])
        t_s, moved = times_s(system), np.linalg.norm(trace.x[run, at] - predicted, axis=1)
        most = bounds.state_deviation(t_s[at], age * system.step_s, missing[run, at])
        errors = bounds.controller_error(np.tile(t_s, len(trace.x)), missing.ravel())
        rounding = 1e-12 * np.linalg.norm(predicted, axis=1) + 1e-300
        return {
            "x": float((moved / (most + rounding)).max(initial=0.0)),
            "e_c": float((trace.controller_error.ravel() / errors).max()),
        }


def random_known_state_loop(rng: np.random.Generator, **fixed: Any) -> KnownStateLoop:
    """A loop of any kind; ``fixed`` replaces some of the drawn values."""
    disturbed = fixed.pop("disturbed", rng.uniform() < 0.5)
    draw: Callable[..., Any] = random_disturbed_loop if disturbed else random_system
    return KnownStateLoop(draw(rng, **fixed))


class LostAreReceived(KnownStateBounds):
    """Every event counts as received by the controller."""

    def state_deviation(self, t_s: Vector, age_s: Vector, missing: Steps) -> Vector:
        return super().state_deviation(t_s, age_s, 0 * missing)

    def controller_error(self, t_s: Vector, missing: Steps) -> Vector:
        return super().controller_error(t_s, 0 * missing)


_EVENTFUL = {"disturbed": False, "beta": 0.01, "sample_steps": 1, "hold_steps": 0, **DRIFTING}

Change = Callable[[KnownStateBounds], KnownStateBounds]
BROKEN: dict[str, tuple[Change, dict[str, Any]]] = {
    "a lost event counts as received": (
        lambda bounds: LostAreReceived(bounds.parts, bounds.delay_s, bounds.disturbances),
        {"mansd": 6, "delay_steps": 0, "step_share": 0.01, **_EVENTFUL},
    ),
    "no delay": (
        lambda bounds: replace(bounds, delay_s=0.0),
        {"mansd": 0, "delay_steps": 4, "step_share": 0.03, **_EVENTFUL},
    ),
    "no disturbance": (
        lambda bounds: replace(bounds, disturbances=0 * bounds.disturbances),
        {"disturbed": True, "push": 1.0, "beta": 0.01},
    ),
}  # fmt: skip


@dataclass
class Case:
    """A loop, and what was certified of it last."""

    loop: Any
    certified: Any = None


def drawn(draw: Callable[..., Any], where: dict[str, Any]) -> Callable[..., Case]:
    """Return what draws cases of loops with these settings."""
    return lambda rng: Case(draw(rng, **where))


def shares_of(names: Iterable[str], certify: Callable[[Case], Any]) -> Callable[[Case], Bounds | None]:
    """Return what certifies a case; the bound of each share is 1."""
    names = tuple(names)

    def bounds(case: Case) -> Bounds | None:
        try:
            case.certified = certify(case)
        except (NoCertificateError, NotDecayingError):
            return None
        return None if case.certified is None else dict.fromkeys(names, 1.0)

    return bounds


def _simulate_disturbed(case: Case, rng: np.random.Generator) -> Observed:
    parts: Sum = case.certified
    return Observed(RUNS, parts.shares(simulate_disturbed(case.loop, rng)))


def _disturbed_bounds(
    change: Callable[[DisturbedLoop], DisturbedLoop],
) -> Callable[[Case], Bounds | None]:
    names = ("e_s", "e_c", "x", "u − Kx", "δ")
    return shares_of(names, lambda case: change(case.loop).certify())


DISTURBED = Kind(
    "disturbed", drawn(disturbed_loops.random_disturbed_loop, {}),
    _disturbed_bounds(lambda loop: loop), _simulate_disturbed,
    {
        name: Broken(
            _disturbed_bounds(change), drawn(disturbed_loops.random_disturbed_loop, where)
        )
        for name, (change, where) in disturbed_loops.BROKEN.items()
    },
)  # fmt: skip


def _observed_bounds(change: Callable[[ObservedLoop], ObservedLoop]) -> Callable[..., Any]:
    def certified(case: Case) -> ScenarioCertificate | None:
        certificate = change(case.loop).certificate()
        return None if certificate.constants is None else certificate

    return shares_of(("e_s", "e_c", "x", "x̂ − x", "δ"), certified)


def _simulate_observed(case: Case, rng: np.random.Generator) -> Observed:
    return Observed(RUNS, worst_shares(case.loop, case.certified, rng))


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
        "the first estimate is exact": _luenberger(
            lambda loop: replace(loop, system=replace(loop.system, known_start=True)),
            noise=0.01, push=0.02, known_start=False,
        ),
    },
)  # fmt: skip


def _simulate_known_state(case: Case, rng: np.random.Generator) -> Observed:
    loop, certificate = case.loop, case.certified
    if isinstance(loop.loop, DisturbedLoop):
        return Observed(RUNS, loop.shares(simulate_disturbed(loop.loop, rng), certificate))
    return search(loop.loop, rng, simulate, lambda _, trace: loop.shares(trace, certificate))


def _known_state_bounds(change: Change) -> Callable[[Case], Bounds | None]:
    return shares_of(("x", "e_c"), lambda case: change(case.loop.bounds()))


KNOWN_STATE = Kind(
    "known state", drawn(random_known_state_loop, {}),
    _known_state_bounds(lambda bounds: bounds), _simulate_known_state,
    {
        name: Broken(
            _known_state_bounds(change), drawn(random_known_state_loop, where)
        )
        for name, (change, where) in BROKEN.items()
    },
)  # fmt: skip
