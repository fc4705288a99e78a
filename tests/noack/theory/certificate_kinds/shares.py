"""Bounds that depend on time and on the losses: what is compared is the largest share of them.

``DISTURBED`` adds the bounds of what decays and of what persists; its disturbances switch at
random, or have the sign for which a random output is largest at a random time. ``OBSERVED`` has
Luenberger's observers, and Kalman filters from their start, with disturbances and noise; filter and
loop are simulated without noack. ``KNOWN_STATE`` has the bounds from the newest event; what is
known at it is read independently.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import Output
from noack.theory.bounds.terms import Constants, NoCertificateError
from noack.theory.certificates.certified_bounds import (
    KnownStateBounds,
    KnownStatePart,
    ScenarioCertificate,
)
from tests.noack.theory import disturbed_loops
from tests.noack.theory.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificate_kinds.decaying import search
from tests.noack.theory.disturbed_loops import (
    DisturbedLoop,
    ObservedLoop,
    Sum,
    random_disturbed_loop,
    random_observed_loop,
    simulate_disturbed,
    worst_shares,
)
from tests.oracles.lossy_loops import RUNS, STEPS, System, Trace, random_system, simulate, times_s

_NONE = 10**6
"""More missing events than any certificate allows."""


@dataclass(frozen=True)
class KnownStateLoop:
    """A loop with or without disturbances, and how its runs are read."""

    loop: System | DisturbedLoop
    lost_are_received: bool = False
    """Mistake: every event counts as received by the controller."""
    events_late: int = 0
    """Mistake: the state is that of so many events before the newest one."""

    @property
    def system(self) -> System:
        return self.loop.system if isinstance(self.loop, DisturbedLoop) else self.loop

    def bounds(self) -> KnownStateBounds:
        """The bounds; raises what the certificate raises."""
        system, delay_s = self.system, self.system.conditions.delay_s
        if not isinstance(self.loop, DisturbedLoop):
            part = KnownStatePart(system.gains(), system.certify(), system.beta)
            return KnownStateBounds((part,), delay_s, np.zeros((len(system.A), 0)))
        found = self.loop.certify()
        parts = (
            KnownStatePart(system.gains(), found.first, system.beta),
            KnownStatePart(self.loop.pushed(), found.rest, 1.0),
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
        if self.lost_are_received:
            missing[:] = 0
        known_at = last[run, at]
        for _ in range(self.events_late):
            known_at = np.where(known_at > 0, last[run, known_at - 1], known_at)
            run, at, age, known_at = (v[known_at >= 0] for v in (run, at, age, known_at))
        leap = expm((system.A + system.B @ system.K) * system.step_s)
        powers = [np.eye(len(leap))]
        for _ in range(STEPS):
            powers.append(leap @ powers[-1])
        predicted = np.einsum("kij,kj->ki", np.array(powers)[age], trace.known[run, known_at])
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


class Mistake(NamedTuple):
    """How a broken copy changes the bounds, or how the runs are read; by default not at all."""

    bounds: Callable[[KnownStateBounds], KnownStateBounds] = lambda bounds: bounds
    reading: Callable[[KnownStateLoop], KnownStateLoop] = lambda loop: loop


def _misread(**changes: Any) -> Mistake:
    return Mistake(reading=lambda loop: replace(loop, **changes))


def _with_constants(**changes: float) -> Mistake:
    return _with_parts(lambda part: part.constants._replace(**changes))


def _with_parts(change: Callable[[KnownStatePart], Constants]) -> Mistake:
    def changed(bounds: KnownStateBounds) -> KnownStateBounds:
        parts = [replace(part, constants=change(part)) for part in bounds.parts]
        return replace(bounds, parts=tuple(parts))

    return Mistake(changed)


def _without_age(part: KnownStatePart) -> Constants:
    """u is K x_c: the input error is at most ‖KW^{−1}‖β̃."""
    own = part.plant.error.now(Output.GAIN) * part.constants.overshoot * part.unit
    return part.constants._replace(received_input_error=own)


_INSTANT = {"disturbed": False, "beta": 0.01, "sample_steps": 1, "delay_steps": 0}
_EVENTFUL = {"mismatch": 0.5, "step_share": 0.01, "hold_steps": 0, **_INSTANT}

BROKEN: dict[str, tuple[Mistake, dict[str, Any]]] = {
    "a lost event counts as received": (
        _misread(lost_are_received=True), {"mansd": 6, **_EVENTFUL},
    ),
    "x of one event before": (_misread(events_late=1), {"mansd": 0, **_EVENTFUL}),
    "no delay": (
        Mistake(lambda bounds: replace(bounds, delay_s=0.0)),
        {"disturbed": False, "n": 1, "m": 1, "mansd": 0, "delay_steps": 4, "sample_steps": 1,
         "hold_steps": 0, "step_share": 0.03},
    ),
    "no age of the input": (
        _with_parts(_without_age),
        {"n": 1, "m": 1, "mansd": 0, "hold_steps": 4, "lag_steps": 2, "step_share": 0.1,
         **_INSTANT},
    ),
    "no start": (
        _with_constants(start_error=0.0),
        {"disturbed": False, "known_start": False, "delay_steps": 4, "beta": 0.01,
         "step_share": 0.03},
    ),
    "no disturbance": (
        Mistake(lambda bounds: replace(bounds, disturbances=0 * bounds.disturbances)),
        {"disturbed": True, "push": 1.0, "beta": 0.01},
    ),
    "no noise": (
        _with_constants(estimation_error=0.0),
        {"disturbed": True, "noise": 0.1, "push": 0.02, "beta": 0.01},
    ),
}  # fmt: skip


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
    "known state", drawn(random_known_state_loop, {}),
    _known_state_bounds(Mistake()), _simulate_known_state,
    {
        name: Broken(
            _known_state_bounds(mistake), drawn(random_known_state_loop, where)
        )
        for name, (mistake, where) in BROKEN.items()
    },
)  # fmt: skip
