"""Losses without a limit: means and mean squares of many runs of each loop.

Mean squares at every fixed time are compared for loops with a schedule; both moments of a run's
largest values, and of e_c at events, under the paper's conditions. A mean over runs is random
itself. So the value that is compared with a bound is the mean minus five standard errors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from noack.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from noack.impairments.loss_prediction import LossProcess
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.random_losses.mean_square_bounds import root_mean_squares
from noack.theory.random_losses.unlimited_losses import BurstCertificate, moment_at_events, moments_of_runs
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certified_loops import certify_loop, conditions_of, gains_of
from tests.oracles.continuous_loops import simulate_continuous_time
from tests.oracles.lossy_loops import DRIFTING, STEPS, Reals, System, random_system, simulate, times_s

_RUNS = 300
_EVENTS = 64
_LOST = range(1, 7)
"""Largest numbers of consecutive losses that count in a run's largest values."""
_ERRORS = 5
_MEANS = {1: "mean", 2: "rms"}
_SIGNALS = {
    "e_s": "sensor_error", "e_c": "controller_error", "x": "state", "u − Kx": "input_error",
}  # fmt: skip


@dataclass(frozen=True)
class RandomLoop:
    """A loop, the probability of a loss, and which runs count."""

    system: System
    probability: float
    most_lost: int
    """Only runs with so few consecutive losses count in the moments of a run's largest values."""


def draw(rng: np.random.Generator, **fixed: Any) -> RandomLoop:
    """Draw a loop."""
    probability = fixed.pop("probability", 10 ** rng.uniform(-2.5, -0.1))
    return RandomLoop(random_system(rng, **fixed), probability, int(rng.choice(_LOST)))


def certify(loop: RandomLoop, *, share: float = 1.0, **changes: float) -> Bounds | None:
    """The bounds, or those of a broken copy: fewer losses, other conditions."""
    system = loop.system
    gains, conditions = gains_of(system), conditions_of(system)._replace(**changes)
    network = conditions, system.beta, share * loop.probability
    try:
        bounds = root_mean_squares(gains.error, gains, *network, refined=True)
    except (NoCertificateError, NotDecayingError):
        return None
    return {
        "e_s": bounds.sensor_error, "e_c": bounds.controller_error, "x": bounds.state,
        "u − Kx": bounds.input_error,
    }  # fmt: skip


def simulate_runs(loop: RandomLoop, rng: np.random.Generator, rate_share: float = 1.0) -> Observed:
    """The largest root mean squares over time, scaled at a share of α, each minus five standard errors."""
    system = loop.system
    lost = rng.uniform(size=(_RUNS, system.events)) < loop.probability
    if not system.known_start:
        lost[:, 0] = False
    delays = rng.integers(0, system.delay_steps + 1, lost.shape)
    if rng.uniform() < 0.5:
        delays[:] = system.delay_steps
    trace = simulate(system, ~lost, delays)
    growth = np.exp(rate_share * system.alpha * times_s(system))
    signals = {name: growth * getattr(trace, field) for name, field in _SIGNALS.items()}
    assert all(values.shape == (_RUNS, STEPS) for values in signals.values())
    return Observed(_RUNS, {name: _least_moment(values, 2) for name, values in signals.items()})


def _least_moment(values: Reals, order: int) -> float:
    """The largest moment over times or events, (runs, k), minus five standard errors."""
    powers = values**order
    error = powers.std(axis=0, ddof=1) / np.sqrt(len(powers))
    return float(np.maximum(powers.mean(axis=0) - _ERRORS * error, 0.0).max()) ** (1 / order)


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


def _draw_continuous(rng: np.random.Generator, **fixed: Any) -> RandomLoop:
    """Loops with many events; half of them have one state that grows in one direction."""
    given = {"sample_steps": 1, "delay_steps": 0, "hold_steps": 0, "known_start": True}
    given |= _SCALAR if rng.uniform() < 0.5 else _EVENTFUL
    return draw(rng, **(given | fixed))


def _certify_runs(loop: RandomLoop, *, share: float = 1.0) -> Bounds | None:
    """The bounds, or those of a broken copy with fewer losses."""
    system = loop.system
    unit, p = np.ones(1), np.array([share * loop.probability])
    losses = LossProcess(unit, unit[:, None], p, first_delivered=False)
    bursts: list[BurstCertificate] = []
    try:
        for most in range(loop.most_lost + 1):
            constants = certify_loop(system, NetworkConditions(most))
            events = int(STEPS * system.step_s / (constants.inter_event_s or np.inf)) + 1
            probability = losses.keeps(LossGuarantee((LongestBurst(most),)), events)
            e_c = constants.delta * system.beta
            bursts.append(
                BurstCertificate(
                    most, probability, events, constants.delta, system.alpha, e_c, constants.state
                )
            )
        at_events = [
            moment_at_events(gains_of(system).error, losses, 0.0, order) * system.beta for order in _MEANS
        ]
    except (NoCertificateError, NotDecayingError):
        return None
    return {
        f"{mean}, {name}": value
        for (mean, run, of_events) in zip(_MEANS.values(), moments_of_runs(bursts), at_events, strict=True)
        for name, value in (
            ("largest e_c", run.controller_error), ("largest x", run.state), ("e_c at events", of_events)
        )
    }  # fmt: skip


def _simulate_continuous(loop: RandomLoop, rng: np.random.Generator) -> Observed:
    delivered = rng.uniform(size=(_RUNS, _EVENTS)) >= loop.probability
    windows = np.lib.stride_tricks.sliding_window_view(delivered, loop.most_lost + 1, axis=1)
    counts = windows.any(axis=2).all(axis=1)[:, None]
    trace = simulate_continuous_time(loop.system, delivered, delivered)
    signals = {
        "largest e_c": counts * trace.controller_error, "largest x": counts * trace.state,
        "e_c at events": trace.error_at_events,
    }  # fmt: skip
    return Observed(_RUNS, {
        f"{mean}, {name}": _least_moment(values, order)
        for order, mean in _MEANS.items() for name, values in signals.items()
    })  # fmt: skip


MOMENT = Kind(
    "moment", _draw_continuous, _certify_runs, _simulate_continuous,
    {
        name: Broken(
            partial(_certify_runs, share=share), partial(_draw_continuous, probability=0.5, **_SCALAR)
        )
        for name, share in (("no losses", 0.0), ("half of the losses", 0.5))
    },
)  # fmt: skip
