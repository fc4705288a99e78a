"""The threshold βe^{−αt}: sampling, delay, held inputs, and losses in bursts and windows.

The loops and their simulation are those of ``tests/oracles/lossy_loops.py``. The losses are all
patterns of six updates that the guarantee allows, repeated; random ones; and those found by
changing single outcomes of the worst run, as long as that makes it worse. The broken copies leave
out one effect each, in loops in which it matters.
"""

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any
from unittest.mock import patch

import numpy as np

from noack.theory.bounds.certificate_terms import Constants, NoCertificateError
from noack.theory.bounds.enclosure import KernelBounds, NotDecayingError, constant_kernel
from noack.theory.bounds.gains import Coefficients, ErrorGains, Output, PlantGains
from noack.theory.certificates.error_rows import ErrorRows
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certified_loops import certify_loop, conditions_of, gains_of
from tests.oracles.lossy_loops import (
    DRIFTING,
    Flags,
    Steps,
    System,
    Trace,
    allowed,
    networks,
    random_system,
    simulate,
    times_s,
)


def without_condition(field: str) -> Callable[[System], Constants]:
    return lambda system: certify_loop(system, conditions_of(system)._replace(**{field: 0.0}))


def without_one_loss(system: System) -> Constants:
    return certify_loop(system, conditions_of(system)._replace(dropouts=system.mansd - 1))


def with_gains(error: type[ErrorGains], plant: type[PlantGains]) -> Callable[[System], Constants]:
    return lambda system: certify_loop(system, plant=gains_of(system, error, plant))


class NoForcedResponse(PlantGains):
    @property
    def states(self) -> dict[Output, Coefficients]:  # type: ignore[override]
        return {output: Coefficients(c.free, 0.0) for output, c in super().states.items()}


class NoFreeResponse(PlantGains):
    @property
    def states(self) -> dict[Output, Coefficients]:  # type: ignore[override]
        return {output: Coefficients(0.0, c.gain) for output, c in super().states.items()}


class NoMismatch(PlantGains):
    @property
    def states(self) -> dict[Output, Coefficients]:  # type: ignore[override]
        return {**super().states, Output.MISMATCH: Coefficients(0.0, 0.0)}


class NoGrowthOfMissing(PlantGains):
    """Leaves out by how much a missing event's e_s had grown since the test before."""

    @property
    def driven(self) -> dict[Output, tuple[KernelBounds, KernelBounds]]:  # type: ignore[override]
        none = constant_kernel(0.0)
        return dict.fromkeys(self.error.outputs, (none, none))


def inputs_of_no_missing_event(system: System) -> Constants:
    """Bounds what enters before every missing event as while no event is missing."""
    true = ErrorRows._stages

    def wrong(*args: Any) -> Any:
        stages = true(*args)
        return stages and stages._replace(inputs=np.broadcast_to(stages.inputs[:1], stages.inputs.shape))

    with patch.object(ErrorRows, "_stages", wrong):
        return certify_loop(system)


def _grown_by_losses(rng: np.random.Generator) -> System:
    """One state; each lost update lets the next error grow faster."""
    near = rng.uniform(0.97, 1.03, 3)
    gain = 12.0 * near[0]
    return System(
        A=np.array([[gain - 1.98]]), B=np.eye(1), K=np.array([[-gain]]), H=np.array([[-2.0]]),
        weight=np.eye(1), x0=near[1:2], alpha=0.3, beta=0.01, known_start=True, mansd=6,
        step_s=0.04 / 3 * near[2], sample_steps=3, delay_steps=0, hold_steps=0, lag_steps=0,
    )  # fmt: skip


def _dominated_by_errors(rng: np.random.Generator) -> System:
    """A loop in which errors drive x further than x(0) is."""
    near = rng.uniform(0.9, 1.1, (4, 2))
    K = np.array([[-6.0, -3.0]]) * near[:1]
    return System(
        A=np.array([[0.0, 1.0], [2.0, -0.5] * near[1]]), B=np.array([[0.0], [1.0]]), K=K,
        H=np.array([[0.1, 1.0], [-3.6, -3.4] * near[2]]),
        weight=np.array([[2.0, 0.4], [0.0, 0.5]]), x0=np.array([0.01, 0.02]) * near[3],
        alpha=0.3, beta=0.1, known_start=True, mansd=3, step_s=0.03, sample_steps=1,
        delay_steps=0, hold_steps=0, lag_steps=0,
    )  # fmt: skip


class NoCurvature(ErrorGains):
    """Bounds the age of an input by the rate of K x_c only."""

    @property
    def outputs(self) -> dict[Output, np.ndarray]:  # type: ignore[override]
        outputs = dict(super().outputs)
        return outputs | {Output.GAIN_CURVATURE: 0 * outputs[Output.GAIN_CURVATURE]}


class OnlyTheFirstMoment(ErrorGains):
    """Uses ‖C W^{−1}‖, the value at τ = 0, instead of the supremum over τ."""

    def missing(self, output: Output, events: int, inter_event_s: float) -> float:
        return events * self.now(output)


class ConstantThreshold(ErrorGains):
    """Ignores that an old error was bounded by an earlier, larger threshold."""

    @property
    def scaled_H(self) -> np.ndarray:  # type: ignore[override]
        return self.H


INSTANT = {"sample_steps": 1, "delay_steps": 0, "hold_steps": 0, "step_share": 0.01}
_FAST = {**DRIFTING, "beta": 0.01}

MUTANTS: dict[str, tuple[Callable[[System], Constants], dict[str, Any]]] = {
    "one loss less": (without_one_loss, {"mansd": 1, **INSTANT, **_FAST}),
    "no sampling period": (without_condition("sampling_s"), {"step_share": 0.03, **_FAST}),
    "no delay": (
        without_condition("delay_s"),
        {"mansd": 0, "delay_steps": 4, "sample_steps": 1, "step_share": 0.03, **_FAST},
    ),
    "no hold": (
        without_condition("hold_s"),
        {"mansd": 0, "hold_steps": 4, "delay_steps": 0, "beta": 0.01, "step_share": 0.03},
    ),
    "no curvature of an old input": (
        with_gains(NoCurvature, PlantGains),
        {"n": 1, "m": 1, "mansd": 0, "sample_steps": 1, "hold_steps": 4, "lag_steps": 2,
         "delay_steps": 0, "beta": 0.01, "step_share": 0.2, "mismatch": 0.0},
    ),
    "no start": (
        without_condition("start_s"),
        {"mansd": 0, "hold_steps": 4, "lag_steps": 2, "beta": 0.01, "step_share": 0.03},
    ),
    "no free response": (with_gains(ErrorGains, NoFreeResponse), {"beta": 0.01}),
    "no mismatch": (with_gains(ErrorGains, NoMismatch), {"mismatch": 0.5, "beta": 0.01}),
    "a missing error has not grown": (
        with_gains(ErrorGains, NoGrowthOfMissing),
        {"mansd": 1, "delay_steps": 0, "hold_steps": 0, "sample_steps": 3, "step_share": 0.03, **_FAST},
    ),
    "only the first moment": (
        with_gains(OnlyTheFirstMoment, PlantGains),
        {"spread": 10.0, "n": 2, "m": 1, "mansd": 1, "alpha_share": 0.8, "mismatch": 0.5,
         "beta": 0.01, **INSTANT},
    ),
    "constant threshold": (
        with_gains(ConstantThreshold, PlantGains),
        {"n": 1, "m": 1, "mansd": 6, "alpha_share": 0.8, "drifts": 1.02, "beta": 0.05,
         **INSTANT, "step_share": 0.03},
    ),
}  # fmt: skip


_REPEATED = 6
_OBJECTIVES = ("controller_error", "state")
_ROUNDS = 2
"""Rounds of changes of the worst run, for each of the objectives."""
_CHANGED = 32
"""Number of its first updates whose outcomes are changed."""


def bounds_of(constants: Constants, beta: float) -> Bounds:
    """The constants that are compared, with the reciprocal of the inter-event time."""
    return {
        "e_s": constants.overshoot * beta,
        "e_c": constants.delta * beta,
        "x": constants.state,
        "u − Kx": constants.input_error,
        "1/δ": 1 / (constants.inter_event_s or 1e-300),
    }


def certified_by(certify: Callable[[System], Constants]) -> Callable[[System], Bounds | None]:
    """The bounds of a certificate; None if there is none."""

    def bounds(system: System) -> Bounds | None:
        try:
            return bounds_of(certify(system), system.beta)
        except (NoCertificateError, NotDecayingError):
            return None

    return bounds


def search(
    system: System,
    rng: np.random.Generator,
    run: Callable[[System, Flags, Steps], Trace] = simulate,
    worst_of: Callable[[System, Trace], dict[str, float]] | None = None,
) -> Observed:
    """Simulate repeated, random and improved patterns of losses.

    ``run`` simulates outcomes and delays, ``worst_of`` returns what is compared with the bounds.
    """
    worst_of = worst_of or _worst
    repeated = np.array(list(product([False, True], repeat=_REPEATED)))
    times = -(-system.events // _REPEATED)
    lost = allowed(np.tile(repeated, times)[:, : system.events], system)
    at_random, delays = networks(int(rng.integers(2**32)), system)
    outcomes = np.concatenate([~np.unique(lost, axis=0), at_random])
    slowest = np.full((len(outcomes) - len(delays), system.events), system.delay_steps)
    delays = np.concatenate([slowest, delays])
    trace = run(system, outcomes, delays)
    runs, worst = len(outcomes), worst_of(system, trace)
    pairs = np.arange(_CHANGED)
    for _ in range(_ROUNDS):
        best = np.repeat([_best(system, trace, name) for name in _OBJECTIVES], _CHANGED)
        outcomes, delays = outcomes[best], delays[best]
        for first in range(0, len(best), _CHANGED):
            outcomes[first + pairs, pairs] ^= True
        outcomes = ~allowed(~outcomes, system)
        trace = run(system, outcomes, delays)
        runs += len(outcomes)
        worst = {name: max(value, worst[name]) for name, value in worst_of(system, trace).items()}
    return Observed(runs, worst)


def _best(system: System, trace: Trace, objective: str) -> int:
    growth = np.exp(system.alpha * times_s(system))
    return int((growth * getattr(trace, objective)).max(axis=1).argmax())


def _worst(system: System, trace: Trace) -> dict[str, float]:
    growth = np.exp(system.alpha * times_s(system))
    signals = {
        "e_s": trace.sensor_error, "e_c": trace.controller_error, "x": trace.state,
        "u − Kx": trace.input_error,
    }  # fmt: skip
    scaled = {name: float((growth * values).max()) for name, values in signals.items()}
    return scaled | {"1/δ": 1 / trace.inter_event_s}


DECAYING = Kind(
    "decaying", random_system, certified_by(certify_loop), search,
    {
        name: Broken(certified_by(certify), partial(random_system, **where))
        for name, (certify, where) in MUTANTS.items()
    }
    | {
        "what enters is that of no missing event": Broken(
            certified_by(inputs_of_no_missing_event), _grown_by_losses
        ),
        "no forced response": Broken(
            certified_by(with_gains(ErrorGains, NoForcedResponse)),
            _dominated_by_errors,
        ),
    },
)  # fmt: skip
