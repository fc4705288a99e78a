"""Losses without a limit: means and mean squares at every fixed time, of many runs of each loop.

A mean over runs is random itself. So the value that is compared with a bound is the mean minus five
standard errors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.terms import NoCertificateError
from noack.theory.random_losses.moments import moments
from tests.noack.theory.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.oracles.lossy_loops import DRIFTING, STEPS, System, random_system, simulate, times_s

_RUNS = 300
_ERRORS = 5
_SIGNALS = {
    "e_s": "sensor_error", "e_c": "controller_error", "x": "state", "u − Kx": "input_error",
}  # fmt: skip


@dataclass(frozen=True)
class RandomLoop:
    """A loop, the probability of a loss, and the order r of the moments."""

    system: System
    probability: float
    order: int


def draw(rng: np.random.Generator, **fixed: Any) -> RandomLoop:
    """Draw a loop; half of its means are mean squares."""
    probability = fixed.pop("probability", 10 ** rng.uniform(-2.5, -0.1))
    return RandomLoop(random_system(rng, **fixed), probability, int(rng.integers(1, 3)))


def certify(loop: RandomLoop, *, share: float = 1.0, **changes: float) -> Bounds | None:
    """The bounds, or those of a broken copy: fewer losses, other conditions."""
    system = loop.system
    gains, conditions = system.gains(), system.conditions._replace(**changes)
    p = share * loop.probability
    try:
        found = moments(gains.error, gains, conditions, system.beta, p, loop.order)
    except (NoCertificateError, NotDecayingError):
        return None
    return {
        "e_s": found.sensor_error, "e_c": found.controller_error, "x": found.state,
        "u − Kx": found.input_error,
    }  # fmt: skip


def simulate_runs(loop: RandomLoop, rng: np.random.Generator, rate_share: float = 1.0) -> Observed:
    """The largest moments over time, scaled at a share of α, each minus five standard errors."""
    system = loop.system
    lost = rng.uniform(size=(_RUNS, system.events)) < loop.probability
    if not system.known_start:
        lost[:, 0] = False
    delays = rng.integers(0, system.delay_steps + 1, lost.shape)
    if rng.uniform() < 0.5:
        delays[:] = system.delay_steps
    trace = simulate(system, ~lost, delays)
    growth, worst = np.exp(rate_share * system.alpha * times_s(system)), {}
    for name, field in _SIGNALS.items():
        powers = (growth * getattr(trace, field)) ** loop.order
        assert powers.shape == (_RUNS, STEPS)
        error = powers.std(axis=0, ddof=1) / np.sqrt(_RUNS)
        least = np.maximum(powers.mean(axis=0) - _ERRORS * error, 0.0)
        worst[name] = float(least.max()) ** (1 / loop.order)
    return Observed(_RUNS, worst)


def _broken(certify: Callable[[RandomLoop], Bounds | None], **fixed: Any) -> Broken:
    return Broken(certify, partial(draw, **fixed))


_EVENTFUL = {"beta": 0.01, "mismatch": 0.5, "step_share": 0.03}
_SCALAR = {**DRIFTING, **_EVENTFUL}

RANDOM_LOSSES = Kind(
    "random losses", draw, certify, simulate_runs,
    {
        "no losses": _broken(
            partial(certify, share=0.0), probability=0.7, sample_steps=1, delay_steps=0,
            hold_steps=0, **_SCALAR,
        ),
        "no sampling period": _broken(
            partial(certify, sampling_s=0.0, spacing_s=0.0), probability=0.01, sample_steps=4,
            delay_steps=0, hold_steps=0, **_EVENTFUL,
        ),
        "no delay": _broken(
            partial(certify, delay_s=0.0, start_s=0.0), probability=0.01, sample_steps=1,
            delay_steps=4, hold_steps=0, known_start=True, **(_SCALAR | {"beta": 0.001}),
        ),
    },
)  # fmt: skip
