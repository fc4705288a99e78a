"""Tries to break the certificates: no bound is exceeded by random loops and worst-case networks.

The same check must detect each broken copy of the certificates.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import find, given, settings
from hypothesis import strategies as st

from noack.theory.certificate import Constants, VoidError
from noack.theory.gains import Coefficients, ErrorGains, Output, PlantGains
from tests.noack.theory.loops import (
    SEARCH,
    System,
    assert_not_smaller,
    certified_or_skipped,
    networks,
    seeds,
    simulate,
    systems,
)


@settings(SEARCH, max_examples=80)
@given(systems(), seeds)
def test_no_certified_bound_is_ever_exceeded(system: System, seed: int) -> None:
    """80 loops with 128 runs each: more than 10,000 runs."""
    certified = certified_or_skipped(system)
    assert simulate(system, *networks(seed, system)).exceeded(system, certified) == []


@pytest.mark.parametrize("harder", ["dropouts", "sampling_s", "delay_s", "hold_s", "start_s"])
@settings(SEARCH, max_examples=2)
@given(systems(), st.floats(0.05, 2.0))
def test_harder_conditions_never_have_smaller_bounds(
    harder: str, system: System, share: float
) -> None:
    easy = system.conditions
    more = 1 if harder == "dropouts" else share * system.step_s
    hard = easy._replace(**{harder: getattr(easy, harder) + more})
    assert_not_smaller(certified_or_skipped(system, hard), system.certify(easy), system)


def without_condition(field: str) -> Callable[[System], Constants]:
    return lambda system: system.certify(system.conditions._replace(**{field: 0.0}))


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
    "no delay": (
        without_condition("delay_s"),
        {"mansd": 0, "delay_steps": 4, "sample_steps": 1, "step_share": 0.03},
    ),
    "no hold": (
        without_condition("hold_s"),
        {"mansd": 0, "hold_steps": 4, "delay_steps": 0, "beta": 0.01, "step_share": 0.03},
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


@pytest.mark.parametrize("mutant", MUTANTS)
def test_runs_exceed_a_broken_certificate_and_not_the_true_one(mutant: str) -> None:
    """In loops in which one effect dominates."""
    broken, where = MUTANTS[mutant]

    def is_caught(case: tuple[System, int]) -> bool:
        system, seed = case
        trace = simulate(system, *networks(seed, system))
        try:
            caught = trace.exceeded(system, broken(system)) != []
            assert not caught or trace.exceeded(system, system.certify()) == []
        except VoidError:
            return False
        return caught

    find(
        st.tuples(systems(**where), seeds),
        is_caught,
        settings=settings(SEARCH, max_examples=100, database=None),
    )
