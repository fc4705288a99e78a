"""Random loops under every trigger policy: its settings, and the same rule written again."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import validate
from noack.core.linear_systems import Matrix
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from tests.noack.theory.event_rules import (
    Area,
    AtLatest,
    Between,
    Compare,
    Decaying,
    Growing,
    NotBefore,
    Quadratic,
)
from tests.noack.theory.loops import EventRule, System, Trace, times_s

_ROUNDING = 1e-9

Case = tuple[dict[str, Any], EventRule]
Rng = np.random.Generator


def _absolute(system: System, rng: Rng) -> Case:
    settings = {"policy": "absolute", "delta": system.beta}
    return settings, Compare(system.weight, system.beta)


def _share(rng: Rng) -> float:
    return float(rng.choice([0.002, 0.01, 0.03]))


def _relative(system: System, rng: Rng) -> Case:
    sigma = _share(rng)
    return {"policy": "relative", "sigma": sigma}, Compare(system.weight, 0.0, sigma)


def _mixed(system: System, rng: Rng) -> Case:
    sigma = _share(rng)
    settings = {"policy": "mixed", "sigma": sigma, "epsilon": system.beta}
    return settings, Compare(system.weight, system.beta, sigma)


def _quadratic(system: System, rng: Rng) -> Case:
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


def _send_on_area(system: System, rng: Rng) -> Case:
    test_s = system.sample_steps * system.step_s
    delta = system.beta * test_s * float(rng.choice([0.5, 3.0, 20.0]))
    settings = {"policy": "send_on_area", "delta_s": delta}
    return settings, Area(system.weight, delta, system.sample_steps, system.step_s)


def _periodic(system: System, rng: Rng) -> Case:
    steps = int(rng.integers(1, 4)) * system.sample_steps
    return {"policy": "periodic", "period_s": steps * system.step_s}, AtLatest(steps)


def _decaying(system: System) -> Case:
    rule = {"beta": system.beta, "alpha_per_s": system.alpha}
    return rule, Decaying(system.weight, system.beta, system.alpha, system.step_s)


def _deadline(system: System, rng: Rng) -> Case:
    rule, event = _decaying(system) if rng.uniform() < 0.5 else _quadratic(system, rng)
    steps = int(rng.integers(1, 9)) * system.sample_steps
    settings = {"policy": "deadline", "rule": rule, "interval_s": steps * system.step_s}
    return settings, AtLatest(steps, event)


def _lyapunov(system: System, rng: Rng) -> Case:
    """With a deadline; its own rule is another one, which bounds e_s as little."""
    steps = int(rng.integers(1, 4)) * system.sample_steps
    rule = {"policy": "lyapunov", "rate_per_s": 0.3}
    settings = {"policy": "deadline", "rule": rule, "interval_s": steps * system.step_s}
    return settings, AtLatest(
        steps, Growing(float(rng.choice([0.9, 2.0, 100.0])), system.sample_steps)
    )


def _self_triggered(system: System, rng: Rng) -> Case:
    shortest, more = (int(rng.integers(1, 3)) * system.sample_steps for _ in range(2))
    settings = {
        "policy": "self_triggered", "beta": system.beta, "alpha_per_s": system.alpha,
        "growth_per_s": 1.0, "mismatch_per_s": 1.0, "shortest_s": shortest * system.step_s,
        "longest_s": (shortest + more) * system.step_s,
    }  # fmt: skip
    return settings, Between(shortest, shortest + more, int(rng.integers(1000)))


def _dwell(system: System, rng: Rng) -> Case:
    rule, event = _decaying(system) if rng.uniform() < 0.5 else _mixed(system, rng)
    steps = int(rng.integers(1, 6)) * system.sample_steps
    settings = {"policy": "dwell", "rule": rule, "interval_s": steps * system.step_s}
    return settings, NotBefore(steps, event)


KINDS: dict[str, Callable[[System, Rng], Case]] = {
    "absolute": _absolute, "relative": _relative, "mixed": _mixed, "quadratic": _quadratic,
    "send_on_area": _send_on_area, "periodic": _periodic, "deadline": _deadline,
    "lyapunov": _lyapunov, "self_triggered": _self_triggered, "dwell": _dwell,
}  # fmt: skip


def policy_case(
    kind: str, system: System, seed: int, push: float = 0.0
) -> tuple[Scenario, EventRule, System]:
    """Return a loop with a policy: its scenario, the same rule, and the loop in whole ns.

    In a third of the cases the loop is in zero-order hold. ``push`` bounds a disturbance of each
    state.
    """
    rng = np.random.default_rng(seed)
    system = replace(system, step_s=max(round(system.step_s * 1e9), 1) / 1e9)
    if rng.uniform() < 1 / 3:
        system = replace(system, H=np.zeros_like(system.H))
    settings, rule = KINDS[kind](system, rng)
    return scenario_with(system, settings, push), rule, system


def scenario_with(system: System, trigger: dict[str, Any], push: float) -> Scenario:
    """The system's matrices with a trigger; the rates have no effect where conditions are given."""
    mode = "model" if system.H.any() else "zoh"
    model: Matrix = system.H - system.B @ system.K if mode == "model" else system.A
    weighted = trigger.get("rule", trigger)
    weighted["weight"] = system.weight.tolist()
    test_s = system.sample_steps * system.step_s
    content: dict[str, Any] = {
        "name": "random", "horizon_s": 1.0, "mode": mode,
        "model": {"A": model.tolist(), "B": system.B.tolist(), "gain": system.K.tolist()},
        "plant": {
            "draw": "given", "A": system.A.tolist(), "B": system.B.tolist(),
            "initial_state": system.x0.tolist(), "rate_hz": 1 / test_s,
        },
        "trigger": trigger,
        "network": {"mansd": system.mansd, "loss": {"model": "worst_case"}},
    }  # fmt: skip
    if push:
        bound = [push] * len(system.A)
        content["plant"]["disturbances"] = [{"kind": "uniform", "at": "state", "bound": bound}]
    return resolve(validate(content, "test"))


def shares_of(trace: Trace, certificate: ScenarioCertificate, system: System) -> dict[str, float]:
    """The largest share of each bound that any run reached."""
    t_s = times_s(system)
    slack = _ROUNDING * trace.state_weighted
    signals = {
        "e_s": (trace.sensor_error, certificate.sensor_error(t_s) + slack),
        "e_c": (trace.controller_error, certificate.controller_error(t_s) + slack),
        "x": (trace.state, certificate.state(t_s) * (1 + _ROUNDING)),
    }
    shares = {name: float((seen / bound).max()) for name, (seen, bound) in signals.items()}
    least_s = certificate.inter_event_s or 0.0
    return shares | {"1/δ": (1 - _ROUNDING) * least_s / trace.inter_event_s}


def exceeded_by(trace: Trace, certificate: ScenarioCertificate, system: System) -> list[str]:
    """The bounds that some run exceeds, beyond rounding."""
    return [name for name, share in shares_of(trace, certificate, system).items() if share > 1]
