"""Random loops with bounded disturbances and noise, and with an observer; their worst signals."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import numpy as np
from scipy.linalg import expm

from noack.core.linear_systems import spectral_abscissa
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.bounds.certificate_terms import CertificatePart, Constants, EstimationBound, TriggerBound
from noack.theory.bounds.gains import ErrorGains, Forcing, PlantGains
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.persistent_bounds import solve_two_parts
from noack.theory.certificates.scenario_certificates import own_plant_scope
from tests.noack.theory.certificates.certified_loops import conditions_of, gains_of
from tests.oracles.lossy_loops import (
    DRIFTING,
    RUNS,
    STEPS,
    EventRule,
    Matrix,
    Reals,
    System,
    Trace,
    Vector,
    networks,
    norms,
    random_system,
    simulate,
    times_s,
)


@dataclass(frozen=True)
class DisturbedLoop:
    """A loop under disturbances D s, |s_i| ≤ 1, for limited times, and noise of the measurement."""

    system: System
    columns: Matrix
    """D, (n, k)."""
    duration_steps: tuple[int, ...]
    noise: Vector
    """Bound of each entry of the noise, (n,)."""
    floor: float
    """0: the threshold falls to 0, and events are separated by the tests only."""

    @property
    def forcing(self) -> Forcing:
        lasting_s = np.array(self.duration_steps) * self.system.step_s
        return Forcing(self.columns, lasting_s, np.zeros(self.system.B.shape[1]))

    def pushed(self) -> PlantGains:
        """The gains of what persists."""
        system, at_rest = self.system, np.zeros((len(self.system.A), 1))
        models = ErrorGains(system.H, system.K, system.weight, 0.0)
        return PlantGains(models, system.A, system.B, at_rest, 0.0, forcing=self.forcing)

    def certify(self) -> "Sum":
        system, floor = self.system, self.floor
        decaying, pushed = gains_of(system), self.pushed()
        models = pushed.error
        estimation = EstimationBound(float(np.linalg.norm(np.abs(system.weight) @ self.noise)))
        first, rest = solve_two_parts(
            CertificatePart(decaying.error, decaying, TriggerBound(system.beta, None)),
            CertificatePart(models, pushed, TriggerBound(floor, None, unit=1.0), estimation),
            conditions_of(system),
        )  # fmt: skip
        return Sum(self.system, first, rest)


@dataclass(frozen=True)
class Sum:
    """The bounds of both parts, added."""

    system: System
    first: Constants
    rest: Constants

    def shares(self, trace: Trace) -> dict[str, float]:
        """The largest shares of the bounds that runs reach."""
        system, first, rest = self.system, self.first, self.rest
        decay, beta = np.exp(-system.alpha * times_s(system)), system.beta
        bounds = {
            "e_s": (trace.sensor_error, first.overshoot * beta * decay + rest.overshoot),
            "e_c": (trace.controller_error, first.delta * beta * decay + rest.delta),
            "x": (trace.state, first.state * decay + rest.state),
            "u − Kx": (trace.input_error, first.input_error * decay + rest.input_error),
        }
        shares = {name: float((values / bound).max()) for name, (values, bound) in bounds.items()}
        return shares | {"δ": (first.inter_event_s or 0.0) / trace.inter_event_s}


def random_disturbed_loop(rng: np.random.Generator, **fixed: Any) -> DisturbedLoop:
    """A loop of any kind; ``fixed`` replaces some of the drawn values."""

    def choose(name: str, values: tuple[Any, ...]) -> Any:
        return fixed.pop(name, values[rng.integers(len(values))])

    size, noise, floor = (
        choose("push", (0.02, 0.2, 1.0)), choose("noise", (0.0, 0.0, 0.01, 0.1)),
        choose("floor", (0.0, 0.05, 0.5)),
    )  # fmt: skip
    lasting, channels = choose("lasting", (STEPS, STEPS, 20)), choose("channels", (1, 2))
    system = random_system(rng, **fixed)
    n = len(system.A)
    columns = size * rng.uniform(-1, 1, (n, channels))
    return DisturbedLoop(system, columns, (lasting,) * channels, noise * rng.uniform(0.2, 1.0, n), floor)


def signals(loop: DisturbedLoop, rng: np.random.Generator) -> tuple[Reals, Reals]:
    """Disturbances (RUNS, STEPS, n) and noise: at random, and with the worst sign for a kernel."""
    system, n, k = loop.system, len(loop.system.A), loop.columns.shape[1]
    s = rng.uniform(-1, 1, (RUNS, STEPS, k))
    flips = rng.uniform(size=s.shape) < rng.choice([0.0, 0.02, 0.1], size=(RUNS, 1, 1))
    switching = np.cumprod(np.where(flips, -1, 1), axis=1)
    s[::4] = switching[::4]
    # The largest response of a random output at a random time.
    generators = np.array([system.A + system.B @ system.K, system.A, system.H])
    powers = np.tile(np.eye(n), (STEPS, 3, 1, 1))
    for age, step in enumerate(repeat(expm(generators * system.step_s), STEPS - 1)):
        powers[age + 1] = powers[age] @ step
    outputs, which = rng.normal(size=(RUNS // 2, n)), rng.integers(3, size=RUNS // 2)
    ages = rng.integers(STEPS // 2, STEPS, RUNS // 2)[:, None] - 1 - np.arange(STEPS)
    pushed = (powers @ loop.columns)[ages.clip(0), which[:, None]]
    worst = np.where(np.einsum("rn,rtnk->rtk", outputs, pushed) >= 0, 1.0, -1.0)
    s[1::2] = np.where(ages[:, :, None] >= 0, worst, s[1::2])
    for i, lasting in enumerate(loop.duration_steps):
        begins = rng.integers(0, STEPS, RUNS)[:, None]
        late = np.arange(STEPS) >= (begins if lasting < STEPS else 0)
        s[:, :, i] *= late & (np.arange(STEPS) < begins + lasting)
    noise = loop.noise * np.where(rng.uniform(size=(RUNS, STEPS, n)) < 0.5, -1.0, 1.0)
    noise[::4] *= rng.uniform(size=(len(noise[::4]), STEPS, n))
    return s @ loop.columns.T, noise


def simulate_disturbed(loop: DisturbedLoop, rng: np.random.Generator) -> Trace:
    """Simulate runs with random and adversarial losses, disturbances and noise."""
    pushes, noise = signals(loop, rng)
    return simulate(
        loop.system,
        *networks(int(rng.integers(2**32)), loop.system),
        floor=loop.floor,
        pushes=pushes,
        estimate=lambda step, x, inputs: x + noise[:, step],
    )


BROKEN: dict[str, tuple[Callable[[DisturbedLoop], DisturbedLoop], dict[str, Any]]] = {
    "no disturbance": (
        lambda loop: replace(loop, columns=0 * loop.columns), {"push": 1.0, "beta": 0.01},
    ),
    "no noise": (
        lambda loop: replace(loop, noise=0 * loop.noise),
        {"noise": 0.1, "push": 0.02, "beta": 0.01},
    ),
    "no floor": (
        lambda loop: replace(loop, floor=0.0), {"floor": 0.5, "push": 0.02, **DRIFTING},
    ),
    "the disturbance ends early": (
        lambda loop: replace(loop, duration_steps=(5,)), {"channels": 1, "push": 1.0},
    ),
}  # fmt: skip
"""By the mistake: the other loop that is certified instead, and loops in which it matters."""

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
    settings: dict[str, Any] | None = None
    """Of another trigger than the decaying threshold, which has ``floor``."""
    rule: EventRule | None = None

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
        threshold = {
            "beta": system.beta, "alpha_per_s": system.alpha, "floor": self.floor,
            "weight": system.weight.tolist(),
        }  # fmt: skip
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
                "trigger": self.settings or threshold,
                "network": {
                    "mansd": 5, "loss": {"model": "lossless"},
                    "initial_sync": "known_state" if system.known_start else "first_packet",
                },
            },
            "observed loop",
        )  # fmt: skip

    def certificate(self) -> ScenarioCertificate:
        return own_plant_scope(resolve(self.scenario)).certificate(conditions_of(self.system))


class Filter:
    """x̂ of all runs: x̂ ← Âd x̂ + B̂d u at each step, x̂ ← x̂ + L (y − C x̂) at each measurement."""

    def __init__(self, loop: ObservedLoop, noise: Reals) -> None:
        system, (n, m) = loop.system, loop.B_model.shape
        both = np.block([[loop.A_model, loop.B_model], [np.zeros((m, n + m))]])
        step = expm(both * system.step_s)
        self._Ad, self._Bd, self._loop, self._noise = step[:n, :n], step[:n, n:], loop, noise
        integral = expm(np.block([[loop.A_model, np.eye(n)], [np.zeros((n, 2 * n))]]) * system.step_s)[:n, n:]
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
    loop: ObservedLoop, certificate: ScenarioCertificate, rng: np.random.Generator
) -> dict[str, float]:
    """Simulate with random and adversarial losses, disturbances and noise; the shares reached."""
    system, (p, n) = loop.system, loop.C.shape
    disturbed = DisturbedLoop(system, loop.push * np.eye(n), (STEPS,) * n, np.full(n, loop.noise), loop.floor)
    pushes, noise = signals(disturbed, rng)
    estimate = Filter(loop, np.concatenate([noise, noise], axis=2)[:, :, :p])
    trace: Trace = simulate(
        system, *networks(int(rng.integers(2**32)), system), floor=loop.floor, pushes=pushes,
        estimate=estimate, rule=deepcopy(loop.rule),
    )  # fmt: skip
    t_s = times_s(system)
    shares = {
        "e_s": trace.sensor_error / certificate.sensor_error(t_s),
        "e_c": trace.controller_error / certificate.controller_error(t_s),
        "x": trace.state / certificate.state(t_s),
        "x̂ − x": estimate.errors / certificate.estimation_error(t_s),
    }
    largest = {name: float(values.max()) for name, values in shares.items()}
    return largest | {"δ": (certificate.inter_event_s or 0.0) / trace.inter_event_s}
