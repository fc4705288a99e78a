"""Random loops whose sensor estimates x: a filter of our own, and the scenario's certificate."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import expm

from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import validate
from noack.core.linear_systems import spectral_abscissa
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.scenario_certificates import own_plant
from tests.noack.theory.disturbed_loops import DisturbedLoop, signals
from tests.noack.theory.loops import (
    RUNS,
    STEPS,
    Matrix,
    Reals,
    System,
    Trace,
    networks,
    norms,
    random_system,
    simulate,
    times_s,
)

_RATES_HZ = np.array([2000, 1000, 500, 250, 200, 125, 100, 50, 40, 25, 20, 10])


@dataclass(frozen=True)
class ObservedLoop:
    """A loop with an observer; ``gain`` is that of Luenberger's, None for a Kalman filter."""

    system: System
    A_model: Matrix
    B_model: Matrix
    C: Matrix
    gain: Matrix | None
    push: float
    noise: float
    floor: float

    @property
    def scenario(self) -> Scenario:
        system, (p, n) = self.system, self.C.shape
        observer: dict[str, Any] = {"kind": "luenberger"}
        if self.gain is None:
            observer = {
                "kind": "kalman", "process_std": [self.push] * n, "noise_std": [self.noise] * p,
                "initial_std": [0.5] * n,
            }  # fmt: skip
        else:
            observer["gain"] = self.gain.tolist()
        rate_hz = 1 / system.step_s
        return validate(
            {
                "name": "observed", "horizon_s": STEPS * system.step_s,
                "model": {
                    "A": self.A_model.tolist(), "B": self.B_model.tolist(),
                    "gain": system.K.tolist(),
                },
                "plant": {
                    "draw": "given", "A": system.A.tolist(), "B": system.B.tolist(),
                    "initial_state": system.x0.tolist(), "rate_hz": rate_hz,
                    "measure_every": system.sample_steps,
                    "measurement": {"C": self.C.tolist(), "noise_bound": [self.noise] * p},
                    "disturbances": [
                        {"kind": "uniform", "at": "state", "bound": [self.push] * n},
                    ],
                },
                "observer": observer,
                "trigger": {
                    "beta": system.beta, "alpha_per_s": system.alpha, "floor": self.floor,
                    "weight": system.weight.tolist(),
                },
                "network": {
                    "mansd": 5, "loss": {"model": "lossless"},
                    "initial_sync": "known_state" if system.known_start else "first_packet",
                },
            },
            "observed loop",
        )  # fmt: skip

    def certificate(self) -> ScenarioCertificate:
        return own_plant(resolve(self.scenario)).certificate(self.system.conditions)


class Filter:
    """x̂ of all runs: x̂ ← Âd x̂ + B̂d u at each step, x̂ ← x̂ + L (y − C x̂) at each measurement."""

    def __init__(self, loop: ObservedLoop, noise: Reals) -> None:
        system, (n, m) = loop.system, loop.B_model.shape
        both = np.block([[loop.A_model, loop.B_model], [np.zeros((m, n + m))]])
        step = expm(both * system.step_s)
        self._Ad, self._Bd, self._loop, self._noise = step[:n, :n], step[:n, n:], loop, noise
        integral = expm(
            np.block([[loop.A_model, np.eye(n)], [np.zeros((n, 2 * n))]]) * system.step_s
        )[:n, n:]
        self._Q, self._R = (
            loop.push**2 * integral @ integral.T, loop.noise**2 * np.eye(len(loop.C)),
        )  # fmt: skip
        self._P = 0.25 * np.eye(n)
        start = system.x0 if system.known_start else np.zeros(n)
        self._x = np.tile(start, (RUNS, 1))
        self.errors = np.zeros((RUNS, STEPS))

    def __call__(self, step: int, x: Reals, inputs: list[Reals]) -> Reals:
        C, P = self._loop.C, self._P
        for u in inputs:
            self._x = self._x @ self._Ad.T + u @ self._Bd.T
            P = self._Ad @ P @ self._Ad.T + self._Q
        L = self._loop.gain
        if L is None:
            L = P @ C.T @ np.linalg.inv(C @ P @ C.T + self._R)
        self._P = P - L @ C @ P
        y = x @ C.T + self._noise[:, step]
        self._x = self._x + (y - self._x @ C.T) @ L.T
        self.errors[:, step] = norms((self._x - x) @ self._loop.system.weight.T)
        return self._x


def random_observed_loop(rng: np.random.Generator, **fixed: Any) -> ObservedLoop:
    """A loop with a Luenberger observer or a Kalman filter, and some model error."""
    differs, push, noise, kalman = (
        fixed.pop(name, values[rng.integers(len(values))])
        for name, values in (
            ("differs", (0.0, 0.0, 0.02)), ("push", (0.02, 0.3)), ("noise", (0.01, 0.1)),
            ("kalman", (False, True)),
        )
    )  # fmt: skip
    fixed = {
        "mismatch": 0.0,
        "hold_steps": int(rng.integers(1, 4)),
        "n": rng.integers(1, 4),
    } | fixed
    system = random_system(rng, **fixed)
    rate_hz = float(_RATES_HZ[np.argmin(np.abs(_RATES_HZ - 1 / system.step_s))])
    n, A, B = len(system.A), system.A, system.B
    changed = A + differs * rng.uniform(-1, 1, A.shape)
    if spectral_abscissa(changed + B @ system.K) < -1.2 * system.alpha:
        system = replace(system, A=changed)
    system = replace(system, step_s=1 / rate_hz)
    C = rng.uniform(-1, 1, (int(rng.integers(1, n + 1)), n))
    gain = None
    if not kalman:  # the steady gain of a filter for other covariances
        from scipy.linalg import solve_discrete_are

        Ad = expm(A * system.step_s * system.sample_steps)
        P = solve_discrete_are(Ad.T, C.T, 0.01 * np.eye(n), rng.uniform(0.01, 1) * np.eye(len(C)))
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(len(C)))
    return ObservedLoop(system, A, B, C, gain, push, noise, float(rng.choice([0.0, 0.3])))


def worst_shares(
    loop: ObservedLoop, found: ScenarioCertificate, rng: np.random.Generator
) -> dict[str, float]:
    """Simulate with random and adversarial losses, disturbances and noise; the shares reached."""
    system, (p, n) = loop.system, loop.C.shape
    disturbed = DisturbedLoop(
        system, loop.push * np.eye(n), (STEPS,) * n, np.full(n, loop.noise), loop.floor
    )
    pushes, noise = signals(disturbed, rng)
    estimate = Filter(loop, np.concatenate([noise, noise], axis=2)[:, :, :p])
    trace: Trace = simulate(
        system, *networks(int(rng.integers(2**32)), system), floor=loop.floor, pushes=pushes,
        estimate=estimate,
    )  # fmt: skip
    t_s = times_s(system)
    shares = {
        "e_s": trace.sensor_error / found.sensor_error(t_s),
        "e_c": trace.controller_error / found.controller_error(t_s),
        "x": trace.state / found.state(t_s),
        "x̂ − x": estimate.errors / found.estimation_error(t_s),
    }
    largest = {name: float(values.max()) for name, values in shares.items()}
    return largest | {"δ": (found.inter_event_s or 0.0) / trace.inter_event_s}
