"""Broken copies of the certificates, each with the loops in which its mistake matters."""

from collections.abc import Callable
from typing import Any

import numpy as np

from noack.theory.bounds.enclosure import constant_kernel
from noack.theory.bounds.gains import Coefficients, ErrorGains, Growth, Output, PlantGains
from noack.theory.bounds.terms import Constants
from tests.noack.theory.loops import System


def without_condition(field: str) -> Callable[[System], Constants]:
    return lambda system: system.certify(system.conditions._replace(**{field: 0.0}))


def with_a_third_of_the_period(system: System) -> Constants:
    third_s = system.conditions.sampling_s / 3
    return system.certify(system.conditions._replace(sampling_s=third_s, spacing_s=third_s))


def without_one_loss(system: System) -> Constants:
    return system.certify(system.conditions._replace(dropouts=system.mansd - 1))


def with_gains(error: type[ErrorGains], plant: type[PlantGains]) -> Callable[[System], Constants]:
    return lambda system: system.certify(plant=system.gains(error, plant))


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


class NoDrift(PlantGains):
    """Ignores what drives e_c while updates are in flight."""

    def growths(self, until_s: float, cells: int) -> dict[Output, Growth]:
        still = constant_kernel(0.0)
        return dict.fromkeys(self.error.outputs, Growth(still, still, np.zeros(1)))


class NoCurvature(ErrorGains):
    """Bounds the age of an input by the rate of K x_c only."""

    @property
    def outputs(self) -> dict[Output, np.ndarray]:  # type: ignore[override]
        found = dict(super().outputs)
        return found | {Output.GAIN_CURVATURE: 0 * found[Output.GAIN_CURVATURE]}

    def hold_remainder(self, hold_s: float) -> float:
        return 0.0


class OnlyTheFirstMoment(ErrorGains):
    """Uses ‖C W^{−1}‖, the value at τ = 0, instead of the supremum over τ."""

    def missing(self, output: Output, events: int, spacing_s: float) -> float:
        return events * self.now(output)


class OnlyTheNewest(ErrorGains):
    """Counts one missing event, whatever their number."""

    def missing(self, output: Output, events: int, spacing_s: float) -> float:
        return super().missing(output, min(events, 1), spacing_s)


class ConstantThreshold(ErrorGains):
    """Ignores that an old error was bounded by an earlier, larger threshold."""

    @property
    def scaled_H(self) -> np.ndarray:  # type: ignore[override]
        return self.H


INSTANT = {"sample_steps": 1, "delay_steps": 0, "hold_steps": 0, "step_share": 0.01}
EVENTFUL = {"mismatch": 0.5, "beta": 0.01, **INSTANT}

MUTANTS: dict[str, tuple[Callable[[System], Constants], dict[str, Any]]] = {
    "one loss less": (without_one_loss, {"mansd": 1, **INSTANT}),
    "no sampling period": (without_condition("sampling_s"), {"step_share": 0.03}),
    "a third of the sampling period": (
        with_a_third_of_the_period,
        {"mansd": 0, "sample_steps": 4, "delay_steps": 0, "hold_steps": 0, "beta": 0.01,
         "step_share": 0.03},
    ),
    "no delay": (
        without_condition("delay_s"),
        {"mansd": 0, "delay_steps": 4, "sample_steps": 1, "step_share": 0.03},
    ),
    "no hold": (
        without_condition("hold_s"),
        {"mansd": 0, "hold_steps": 4, "delay_steps": 0, "beta": 0.01, "step_share": 0.03},
    ),
    "no drift in flight": (
        with_gains(ErrorGains, NoDrift),
        {"mansd": 0, "delay_steps": 4, "sample_steps": 1, "hold_steps": 0, "beta": 0.01,
         "mismatch": 0.5, "step_share": 0.03},
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
    "no forced response": (
        with_gains(ErrorGains, NoForcedResponse),
        {"n": 1, "m": 1, "mansd": 6, "beta": 1.0, "mismatch": 0.5, "alpha_share": 0.8},
    ),
    "no free response": (with_gains(ErrorGains, NoFreeResponse), {"beta": 0.01}),
    "no mismatch": (with_gains(ErrorGains, NoMismatch), {"mismatch": 0.5, "beta": 0.01}),
    "only the first moment": (
        with_gains(OnlyTheFirstMoment, PlantGains),
        {"spread": 10.0, "n": 2, "m": 1, "mansd": 1, "alpha_share": 0.8, **EVENTFUL},
    ),
    "only the newest missing event": (
        with_gains(OnlyTheNewest, PlantGains), {"mansd": 6, **INSTANT},
    ),
    "constant threshold": (
        with_gains(ConstantThreshold, PlantGains),
        {"n": 1, "m": 1, "mansd": 6, "alpha_share": 0.8, **EVENTFUL},
    ),
}  # fmt: skip
