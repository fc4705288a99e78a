"""Every policy under disturbances, for all plants of a box, and with an observer.

The rules and their settings are those of ``policies.py``; each loop has one of them. A box's plants
are its corners; half of the runs switch between them at every step.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.scenario_certificates import certify, certify_box
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certificate_kinds.policies import (
    POLICY_KINDS,
    PolicyCase,
    in_whole_ns,
    policy_shares,
    scenario_with,
)
from tests.noack.theory.certificates.certificate_kinds.shares import Case, drawn, shares_of
from tests.noack.theory.certificates.certified_loops import conditions_of
from tests.noack.theory.certificates.disturbed_loops import (
    DisturbedLoop,
    ObservedLoop,
    random_observed_loop,
    signals,
    worst_shares,
)
from tests.oracles.lossy_loops import (
    RUNS,
    STEPS,
    EventRule,
    Plants,
    System,
    networks,
    random_system,
    simulate,
)

_ROUNDS = 3
_SHORT_STEPS = {"step_share": 0.002}
_INSTANT = {"delay_steps": 0, "hold_steps": 0}


@dataclass(frozen=True)
class DisturbedPolicy:
    """A loop with a policy; its plants are within ``halfwidth`` of each entry of A and B."""

    system: System
    settings: dict[str, Any]
    rule: EventRule
    push: float
    """Bound of the disturbance of each state."""
    halfwidth: float

    @property
    def scenario(self) -> Scenario:
        """The resolved scenario."""
        system, box = self.system, {}
        if self.halfwidth:
            matrices = ("uncertainty_A", system.A), ("uncertainty_B", system.B)
            box = {name: np.full_like(M, self.halfwidth).tolist() for name, M in matrices}
        rate_hz = 1 / (system.sample_steps * system.step_s)
        return scenario_with(system, deepcopy(self.settings), self.push, rate_hz=rate_hz, **box)

    def certificate(self) -> ScenarioCertificate:
        """The certificate of the box, or of the plant if there is no box."""
        resolved, conditions = self.scenario, conditions_of(self.system)
        return certify_box(resolved, conditions) or certify(resolved, conditions)

    def simulated(self, certificate: ScenarioCertificate, rng: np.random.Generator) -> dict[str, float]:
        """Simulate runs with adversarial losses, disturbances and plants; the shares reached."""
        system, n = self.system, len(self.system.A)
        loop = DisturbedLoop(system, self.push * np.eye(n), (STEPS,) * n, np.zeros(n), 0.0)
        pushes, _ = signals(loop, rng)
        plants = None
        if self.halfwidth:
            pool = [
                (_corner(system.A, self.halfwidth, rng), _corner(system.B, self.halfwidth, rng))
                for _ in range(6)
            ]
            which = rng.integers(0, len(pool), (RUNS, STEPS))
            which[::2] = which[::2, :1]
            plants = Plants(pool, which)
        outcomes = networks(int(rng.integers(2**32)), system)
        trace = simulate(system, *outcomes, rule=deepcopy(self.rule), pushes=pushes, plants=plants)
        return policy_shares(trace, certificate, system)


def _corner(M: np.ndarray, halfwidth: float, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(M + halfwidth * rng.choice([-1.0, 1.0], M.shape))


def _policy(system: System, rng: np.random.Generator, names: tuple[str, ...]) -> PolicyCase:
    """A policy with the system's norm."""
    settings, rule = POLICY_KINDS[str(rng.choice(names or list(POLICY_KINDS)))](system, rng)
    settings.get("rule", settings)["weight"] = system.weight.tolist()
    return settings, rule


def _usual(rng: np.random.Generator) -> dict[str, Any]:
    """Mostly short steps, often without delays: bounds are tight then."""
    short = _SHORT_STEPS if rng.uniform() < 0.7 else {}
    return short | (_INSTANT if rng.uniform() < 0.4 else {})


def random_disturbed_policy(
    rng: np.random.Generator, *, policies: tuple[str, ...] = (), **fixed: Any
) -> DisturbedPolicy:
    """A loop with disturbances, a box or both; ``fixed`` replaces some of the drawn values."""
    halfwidth = fixed.pop("halfwidth", float(rng.choice([0.0, 0.003, 0.02, 0.06])))
    push = fixed.pop("push", float(rng.choice([0.0 if halfwidth else 0.5, 0.02, 0.2, 1.0])))
    box = {"mismatch": 0.0, "n": int(rng.integers(1, 4))} if halfwidth else {}
    system = in_whole_ns(random_system(rng, **{**_usual(rng), **box, **fixed}))
    if rng.uniform() < 1 / 3:
        system = replace(system, H=np.zeros_like(system.H))
    return DisturbedPolicy(system, *_policy(system, rng, policies), push, halfwidth)


def _observed(rng: np.random.Generator, *, policies: tuple[str, ...] = (), **fixed: Any) -> ObservedLoop:
    values = _usual(rng)
    # The gain of a Kalman filter with short steps changes too long.
    values |= ({"kalman": False} if "step_share" in values else {}) | fixed
    # The filter knows the input of a step's begin only, so it has to be held.
    values["hold_steps"] = max(1, values.get("hold_steps", int(rng.integers(1, 4))))
    loop = replace(random_observed_loop(rng, **values), floor=0.0)
    settings, rule = _policy(loop.system, rng, policies)
    return replace(loop, settings=settings, rule=rule)


_Loop = DisturbedPolicy | ObservedLoop


def _bounds(change: Callable[[Any], _Loop], *names: str) -> Callable[[Case], Bounds | None]:
    def certified(case: Case) -> ScenarioCertificate | None:
        certificate = change(case.loop).certificate()
        return None if certificate.constants is None else certificate

    return shares_of(("e_s", "e_c", "x", *names), certified)


def _simulate(
    simulated: Callable[[Any, ScenarioCertificate, np.random.Generator], dict[str, float]],
) -> Callable[[Case, np.random.Generator], Observed]:
    def observed(case: Case, rng: np.random.Generator) -> Observed:
        rounds = [simulated(case.loop, case.certified, rng) for _ in range(_ROUNDS)]
        return Observed(_ROUNDS * RUNS, {name: max(shares[name] for shares in rounds) for name in rounds[0]})

    return observed


_DRIVEN = {"policies": ("absolute", "mixed", "self_triggered"), "beta": 0.01, **_SHORT_STEPS, **_INSTANT}


def _kind(
    name: str,
    draw: Callable[..., _Loop],
    simulated: Callable[[Any, ScenarioCertificate, np.random.Generator], dict[str, float]],
    further_bounds: tuple[str, ...],
    mistakes: dict[str, tuple[Callable[[Any], _Loop], dict[str, Any]]],
) -> Kind:
    broken = {
        mistake: Broken(_bounds(change, *further_bounds), drawn(draw, {**_DRIVEN, **where}))
        for mistake, (change, where) in mistakes.items()
    }
    return Kind(
        name, drawn(draw, {}), _bounds(lambda loop: loop, *further_bounds), _simulate(simulated), broken
    )


DISTURBED_POLICIES = (
    _kind(
        "disturbed policies", random_disturbed_policy, DisturbedPolicy.simulated, ("1/δ",),
        {
            "no disturbance": (partial(replace, push=0.0), {"halfwidth": 0.0, "push": 1.0}),
            "a fifth of the box": (
                lambda loop: replace(loop, halfwidth=loop.halfwidth / 5),
                {"halfwidth": 0.06, "push": 0.0},
            ),
        },
    ),
    _kind(
        "observed policies", _observed, worst_shares, ("x̂ − x", "δ"),
        {
            "no noise": (partial(replace, noise=0.0), {"noise": 0.1, "push": 0.02, "kalman": False}),
            "no disturbance": (partial(replace, push=0.0), {"noise": 0.01, "push": 0.3, "kalman": False}),
        },
    ),
)  # fmt: skip
