"""The trigger policies besides the paper's: the loops are drawn and simulated as for ``decaying``.

First the rules, written again without ``noack.trigger_policies``. A rule is called at every test of the
trigger, with the step, the steps since each run's last event, x and e_s, and returns which runs
have an event. Then random settings of each policy, and the broken copies, which leave out one part
of what a trigger does.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from noack.core.linear_systems import Matrix
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.bounds import error_growth
from noack.theory.bounds.certificate_terms import NetworkConditions, TriggerBound
from noack.theory.bounds.trigger_bounds import ComparisonBound, TriggerBounds
from noack.theory.certificates import scenario_certificates
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.scenario_certificates import certify, trigger_bounds
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certificate_kinds.decaying import search
from tests.noack.theory.certificates.certificate_kinds.shares import Case, shares_of
from tests.noack.theory.certificates.certified_loops import conditions_of
from tests.oracles.lossy_loops import (
    DRIFTING,
    EventRule,
    Flags,
    Reals,
    Steps,
    System,
    Trace,
    norms,
    random_system,
    simulate,
    times_s,
)


@dataclass
class Compare:
    """‖W e_s‖² > (share ‖W x‖)² + (threshold e^{−decay k})² in step k."""

    weight: Matrix
    threshold: float
    share: float = 0.0
    decay: float = 0.0

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        threshold = self.threshold * np.exp(-self.decay * step)
        if self.share:
            threshold = np.hypot(self.share * norms(x @ self.weight.T), threshold)
        return np.asarray(norms(e_s @ self.weight.T) > threshold)


@dataclass
class Quadratic:
    """zᵀQz > ε, tested every ``every`` steps."""

    Q: Matrix
    epsilon: float
    every: int

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        z = np.hstack([x, e_s])
        above = np.einsum("ri,ij,rj->r", z, self.Q, z) > self.epsilon
        return np.asarray(above & (step % self.every == 0))


@dataclass
class Area:
    """The trapezoidal sum of ‖W e_s‖ since the last event exceeds δ."""

    weight: Matrix
    delta: float
    every: int
    """Steps between two tests."""
    step_s: float
    _area: Reals = field(default_factory=lambda: np.zeros(1))
    _before: Reals = field(default_factory=lambda: np.zeros(1))

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        error, is_fresh = norms(e_s @ self.weight.T), since <= self.every
        before = np.where(is_fresh, 0.0, self._before if step else 0.0)
        added = self.every * self.step_s * (before + error) / 2
        self._area = np.where(is_fresh, 0.0, self._area if step else 0.0) + added * (step > 0)
        self._before = error
        return np.asarray(self._area > self.delta)


@dataclass
class AtLatest:
    """Any rule, and at the latest ``steps`` after the last event; without one, periodic."""

    steps: int
    rule: EventRule | None = None

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        due = since >= self.steps
        return due if self.rule is None else due | self.rule(step, since, x, e_s)


@dataclass
class NotBefore:
    """Any rule, but not earlier than ``steps`` after the last event."""

    steps: int
    rule: EventRule

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        return self.rule(step, since, x, e_s) & (since >= self.steps)


@dataclass
class GrowthRule:
    """‖x‖² has grown by a factor since the last event; it says nothing about e_s."""

    factor: float
    every: int
    _size: Reals = field(default_factory=lambda: np.zeros(1))

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        size = np.einsum("ri,ri->r", x, x)
        self._size = np.where(since <= self.every, size, self._size if step else size)
        return np.asarray(size > self.factor * self._size)


@dataclass
class AnyTimeRule:
    """After any number of steps between two; it stands for every forecast."""

    shortest: int
    longest: int
    seed: int

    def __call__(self, step: int, since: Steps, x: Reals, e_s: Reals) -> Flags:
        wanted = np.random.default_rng((self.seed, step)).uniform(size=len(x)) < 0.3
        return np.asarray((since >= self.longest) | (wanted & (since >= self.shortest)))


_RELATIVE_ROUNDING = 1e-9

PolicyCase = tuple[dict[str, Any], EventRule]
Rng = np.random.Generator


def _absolute(system: System, rng: Rng) -> PolicyCase:
    settings = {"policy": "absolute", "delta": system.beta}
    return settings, Compare(system.weight, system.beta)


def _share(rng: Rng) -> float:
    return float(rng.choice([0.002, 0.01, 0.03]))


def _relative(system: System, rng: Rng) -> PolicyCase:
    sigma = _share(rng)
    return {"policy": "relative", "sigma": sigma}, Compare(system.weight, 0.0, sigma)


def _mixed(system: System, rng: Rng) -> PolicyCase:
    sigma = _share(rng)
    settings = {"policy": "mixed", "sigma": sigma, "epsilon": system.beta}
    return settings, Compare(system.weight, system.beta, sigma)


def _quadratic(system: System, rng: Rng) -> PolicyCase:
    n, grid = len(system.A), int(rng.integers(1, 3)) * system.sample_steps
    error = rng.uniform(-1, 1, (n, n)) + 1.5 * np.eye(n)
    cross = float(rng.choice([0.02, 0.3])) * rng.uniform(-1, 1, (n, n))
    Q = np.block([[-(0.03**2) * np.eye(n), cross.T], [cross, error.T @ error]])
    epsilon = float(rng.choice([0.0, system.beta**2]))
    settings = {
        "policy": "quadratic", "Q": Q.tolist(), "epsilon": epsilon,
        "period_s": grid * system.step_s,
    }  # fmt: skip
    return settings, Quadratic(Q, epsilon, grid)


def _send_on_area(system: System, rng: Rng) -> PolicyCase:
    test_s = system.sample_steps * system.step_s
    delta = system.beta * test_s * float(rng.choice([0.5, 3.0, 20.0]))
    settings = {"policy": "send_on_area", "delta_s": delta}
    return settings, Area(system.weight, delta, system.sample_steps, system.step_s)


def _periodic(system: System, rng: Rng) -> PolicyCase:
    steps = int(rng.integers(1, 4)) * system.sample_steps
    return {"policy": "periodic", "period_s": steps * system.step_s}, AtLatest(steps)


def _decaying(system: System) -> PolicyCase:
    rule = {"beta": system.beta, "alpha_per_s": system.alpha}
    return rule, Compare(system.weight, system.beta, decay=system.alpha * system.step_s)


def _deadline(system: System, rng: Rng) -> PolicyCase:
    rule, event = _decaying(system) if rng.uniform() < 0.5 else _quadratic(system, rng)
    steps = int(rng.integers(1, 9)) * system.sample_steps
    settings = {"policy": "deadline", "rule": rule, "interval_s": steps * system.step_s}
    return settings, AtLatest(steps, event)


def _lyapunov(system: System, rng: Rng) -> PolicyCase:
    """With a deadline; its own rule is another one, which bounds e_s as little."""
    steps = int(rng.integers(1, 4)) * system.sample_steps
    rule = {"policy": "lyapunov", "rate_per_s": 0.3}
    settings = {"policy": "deadline", "rule": rule, "interval_s": steps * system.step_s}
    return settings, AtLatest(steps, GrowthRule(float(rng.choice([0.9, 2.0, 100.0])), system.sample_steps))


def _self_triggered(system: System, rng: Rng) -> PolicyCase:
    shortest, more = (int(rng.integers(1, 3)) * system.sample_steps for _ in range(2))
    settings = {
        "policy": "self_triggered", "beta": system.beta, "alpha_per_s": system.alpha,
        "growth_per_s": 1.0, "mismatch_per_s": 1.0, "shortest_s": shortest * system.step_s,
        "longest_s": (shortest + more) * system.step_s,
    }  # fmt: skip
    return settings, AnyTimeRule(shortest, shortest + more, int(rng.integers(1000)))


def _dwell(system: System, rng: Rng) -> PolicyCase:
    rule, event = _decaying(system) if rng.uniform() < 0.5 else _mixed(system, rng)
    steps = int(rng.integers(1, 6)) * system.sample_steps
    settings = {"policy": "dwell", "rule": rule, "interval_s": steps * system.step_s}
    return settings, NotBefore(steps, event)


POLICY_KINDS: dict[str, Callable[[System, Rng], PolicyCase]] = {
    "absolute": _absolute, "relative": _relative, "mixed": _mixed, "quadratic": _quadratic,
    "send_on_area": _send_on_area, "periodic": _periodic, "deadline": _deadline,
    "lyapunov": _lyapunov, "self_triggered": _self_triggered, "dwell": _dwell,
}  # fmt: skip


def in_whole_ns(system: System) -> System:
    """The system with steps of a whole number of nanoseconds."""
    return replace(system, step_s=max(round(system.step_s * 1e9), 1) / 1e9)


def policy_case(kind: str, system: System, seed: int) -> tuple[Scenario, EventRule, System]:
    """Return a loop with a policy: its scenario, the same rule, and the loop in whole ns.

    In a third of the cases the loop is in zero-order hold.
    """
    rng = np.random.default_rng(seed)
    system = in_whole_ns(system)
    if rng.uniform() < 1 / 3:
        system = replace(system, H=np.zeros_like(system.H))
    settings, rule = POLICY_KINDS[kind](system, rng)
    rate_hz = 1 / (system.sample_steps * system.step_s)
    return scenario_with(system, settings, rate_hz=rate_hz), rule, system


def scenario_of(system: System, trigger: dict[str, Any], **tables: dict[str, Any]) -> Scenario:
    """The system's matrices with a trigger, not resolved; ``tables`` has more settings.

    A plant of another kind or draw takes the place of A and B.
    """
    mode = "model" if system.H.any() else "zoh"
    model: Matrix = system.H - system.B @ system.K if mode == "model" else system.A
    content: dict[str, Any] = {
        "name": "random", "horizon_s": 1.0, "mode": mode,
        "model": {"A": model.tolist(), "B": system.B.tolist(), "gain": system.K.tolist()},
        "plant": {"initial_state": system.x0.tolist()},
        "trigger": trigger,
        "network": {"mansd": system.mansd, "loss": {"model": "worst_case"}},
    }  # fmt: skip
    if not tables.get("plant", {}).keys() & {"system", "draw"}:
        content["plant"] |= {"draw": "given", "A": system.A.tolist(), "B": system.B.tolist()}
    for name, settings in tables.items():
        content[name] = content.get(name, {}) | settings
    return validate(content, "test")


def scenario_with(system: System, trigger: dict[str, Any], push: float = 0.0, **plant: Any) -> Scenario:
    """The same in the system's norm; the rates have no effect where conditions are given.

    ``push`` bounds a disturbance of each state.
    """
    trigger.get("rule", trigger)["weight"] = system.weight.tolist()
    if push:
        bound = [push] * len(system.A)
        plant["disturbances"] = [{"kind": "uniform", "at": "state", "bound": bound}]
    return resolve(scenario_of(system, trigger, plant=plant))


def policy_shares(trace: Trace, certificate: ScenarioCertificate, system: System) -> dict[str, float]:
    """The largest share of each bound that any run reached."""
    t_s = times_s(system)
    slack = _RELATIVE_ROUNDING * trace.state_weighted
    signals = {
        "e_s": (trace.sensor_error, certificate.sensor_error(t_s) + slack),
        "e_c": (trace.controller_error, certificate.controller_error(t_s) + slack),
        "x": (trace.state, certificate.state(t_s) * (1 + _RELATIVE_ROUNDING)),
    }
    shares = {name: float((seen / bound).max()) for name, (seen, bound) in signals.items()}
    least_s = certificate.inter_event_s or 0.0
    return shares | {"1/δ": (1 - _RELATIVE_ROUNDING) * least_s / trace.inter_event_s}


def exceeded_by(trace: Trace, certificate: ScenarioCertificate, system: System) -> list[str]:
    """The bounds that some run exceeds, beyond rounding."""
    return [name for name, share in policy_shares(trace, certificate, system).items() if share > 1]


Conditions = NetworkConditions


@dataclass(frozen=True)
class NoShares(TriggerBounds):
    @property
    def comparison(self) -> ComparisonBound | None:  # type: ignore[override]
        bound = super().comparison
        return None if bound is None else bound._replace(shares=(), has_root=False)


@dataclass(frozen=True)
class NoCrossTerm(TriggerBounds):
    @property
    def comparison(self) -> ComparisonBound | None:  # type: ignore[override]
        bound = super().comparison
        return None if bound is None else bound._replace(shares=bound.shares[:1])


@dataclass(frozen=True)
class NoDwell(TriggerBounds):
    def bound(self, conditions: Conditions, level: float, least_level: float | None) -> TriggerBound:
        return super().bound(conditions, level, least_level)._replace(untested_s=0.0, further=())


@dataclass(frozen=True)
class NoTimeOfTheArea(TriggerBounds):
    """Takes the average of ‖e_s‖ for its value now."""

    def bound(self, conditions: Conditions, level: float, least_level: float | None) -> TriggerBound:
        bound = super().bound(conditions, level, least_level)
        return bound._replace(
            window_s=0.0, further=tuple(further._replace(window_s=0.0) for further in bound.further)
        )


@dataclass(frozen=True)
class ShortChord(TriggerBounds):
    """Takes a smaller share of x than that of the chord."""

    def _slope(self, level: float) -> Mapping[str, float]:
        return {name: slope / 4 for name, slope in super()._slope(level).items()}


@dataclass(frozen=True)
class AThirdOfTheTime(TriggerBounds):
    """Takes a third of the time up to the next event."""

    def bound(self, conditions: Conditions, level: float, least_level: float | None) -> TriggerBound:
        whole, h_s = super().bound(conditions, level, least_level), conditions.sampling_s
        assert not all(bound.is_tested for bound in whole.all_bounds)

        def wrong(bound: TriggerBound) -> TriggerBound:
            third_s = (bound.untested_s + h_s) / 3
            return bound if bound.is_tested else bound._replace(untested_s=third_s - h_s)

        return wrong(whole)._replace(further=tuple(map(wrong, whole.further)))


def with_trigger(kind: type[TriggerBounds]) -> Callable[[Scenario, Conditions], Any]:
    def broken(resolved: Scenario, conditions: Conditions) -> ScenarioCertificate:
        true = trigger_bounds(resolved)
        wrong = kind(true.rule, true.weight, true.fastest_per_s)
        with patch.object(scenario_certificates, "trigger_bounds", lambda *_, **__: wrong):
            return certify(resolved, conditions)

    return broken


def patched(target: Any, name: str, wrong: Any) -> Callable[[Scenario, Conditions], Any]:
    def broken(resolved: Scenario, conditions: Conditions) -> ScenarioCertificate:
        with patch.object(target, name, wrong):
            return certify(resolved, conditions)

    return broken


def youngest(bound: TriggerBound, sampling_s: float) -> Any:
    """Ages of a mean, most of which are that of the last test."""
    return np.append(np.full(9, 1e-9), 1.0) * (bound.window_s + sampling_s) if bound.window_s else None


def without_one_loss(resolved: Scenario, conditions: Conditions) -> ScenarioCertificate:
    return certify(resolved, conditions._replace(dropouts=conditions.dropouts - 1))


def without(name: str) -> Callable[[Scenario, Conditions], Any]:
    """The certificate for conditions in which a time is 0."""

    def broken(resolved: Scenario, conditions: Conditions) -> ScenarioCertificate:
        return certify(resolved, conditions._replace(**{name: 0.0}))

    return broken


INSTANT = {"delay_steps": 0, "hold_steps": 0, "known_start": True, "window": (1, 1), "recovery": 0}
LATE = {"n": 2, "m": 1, "known_start": True, "window": (1, 1), "recovery": 0, "lag_steps": 0,
        "sample_steps": 2, "mansd": 1}  # fmt: skip
FAR = {**DRIFTING, "step_share": 0.01, "sample_steps": 1, **INSTANT}

BROKEN_POLICIES: dict[str, tuple[str, Callable[[Scenario, Conditions], Any], dict[str, Any]]] = {
    **{
        f"{kind}, one loss less": (kind, without_one_loss, {**FAR, "mansd": 1, "beta": 0.01})
        for kind in (
            "absolute", "mixed", "quadratic", "deadline", "self_triggered", "periodic", "lyapunov",
        )
    },
    "periodic, no age of the input": (
        "periodic", without("hold_s"), {
            **LATE, "delay_steps": 0, "hold_steps": 1, "mansd": 6, "mismatch": 0.0,
            "step_share": 0.03,
        },
    ),
    "self_triggered, no late update": (
        "self_triggered", without("delay_s"), {**LATE, "delay_steps": 2, "hold_steps": 0},
    ),
    "self_triggered, no updates in flight at the next events": (
        "self_triggered", without("delay_s"), {
            **LATE, "sample_steps": 1, "delay_steps": 6, "hold_steps": 0, "step_share": 0.03,
        },
    ),
    "lyapunov, no start without an input": (
        "lyapunov", without("start_s"), {
            **LATE, "delay_steps": 2, "hold_steps": 0, "mismatch": 0.0, "known_start": False,
        },
    ),
    "relative, no share": ("relative", with_trigger(NoShares), {**FAR, "mansd": 0}),
    "mixed, no share": ("mixed", with_trigger(NoShares), {**FAR, "mansd": 0, "beta": 0.01}),
    "quadratic, no cross term": (
        "quadratic", with_trigger(NoCrossTerm), {**FAR, "mansd": 0, "beta": 0.001},
    ),
    "dwell, no growth before the test": (
        "dwell", with_trigger(NoDwell), {**FAR, "mansd": 0, "beta": 0.001, "step_share": 0.03},
    ),
    "send_on_area, no growth after the average": (
        "send_on_area", with_trigger(NoTimeOfTheArea), {**FAR, "mansd": 0, "beta": 0.01},
    ),
    "send_on_area, a mean over the last moment": (
        "send_on_area", patched(error_growth, "_mean_ages_s", youngest),
        {**FAR, "mansd": 0, "beta": 0.01},
    ),
    "mixed, a chord that is too short": (
        "mixed", with_trigger(ShortChord), {**FAR, "mansd": 0, "beta": 0.01},
    ),
    "periodic, a third of the period": (
        "periodic", with_trigger(AThirdOfTheTime), {**FAR, "mansd": 0},
    ),
    "deadline, a third of the deadline": (
        "deadline", with_trigger(AThirdOfTheTime), {**FAR, "mansd": 0, "beta": 1.0},
    ),
    "self_triggered, a third of the longest time": (
        "self_triggered", with_trigger(AThirdOfTheTime), {**FAR, "mansd": 0},
    ),
    "deadline of lyapunov, a third of the deadline": (
        "lyapunov", with_trigger(AThirdOfTheTime), {**FAR, "mansd": 0},
    ),
}  # fmt: skip
"""By the mistake: the policy, its wrong certificate, and loops in which the mistake matters."""


_Certify = Callable[[Scenario, NetworkConditions], ScenarioCertificate]


def _draw(kind: str, where: dict[str, Any], rng: np.random.Generator) -> Case:
    if not where and rng.uniform() < 0.5:
        where = {"step_share": 0.002}
    system = random_system(rng, **where)
    return Case(policy_case(kind, system, int(rng.integers(2**32))))


def _bounds(certify: _Certify) -> Callable[[Case], Bounds | None]:
    def certified(case: Case) -> ScenarioCertificate | None:
        resolved, _, system = case.loop
        certificate = certify(resolved, conditions_of(system))
        return None if certificate.constants is None else certificate

    return shares_of(("e_s", "e_c", "x", "1/δ"), certified)


def _simulate(case: Case, rng: np.random.Generator) -> Observed:
    """Search for losses that exceed the certificate."""
    _, rule, drawn = case.loop

    def run(system: System, outcomes: Flags, delays: Steps) -> Trace:
        return simulate(system, outcomes, delays, rule=rule)

    def worst(system: System, trace: Trace) -> dict[str, float]:
        return policy_shares(trace, case.certified, system)

    return search(drawn, rng, run, worst)


def _kinds() -> Iterable[Kind]:
    for kind in POLICY_KINDS:
        broken = {
            mistake.removeprefix(f"{kind}, "): Broken(_bounds(wrong), partial(_draw, kind, where))
            for mistake, (policy, wrong, where) in BROKEN_POLICIES.items()
            if policy == kind
        }
        yield Kind(kind, partial(_draw, kind, {}), _bounds(certify), _simulate, broken)


POLICIES = tuple(_kinds())
