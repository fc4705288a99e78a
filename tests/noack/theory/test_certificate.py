"""Tries to break the certificates: no bound is exceeded by random loops and worst-case networks.

The same check must detect each broken copy of the certificates.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, find, given, settings
from hypothesis import strategies as st

from noack.theory.certificate import Constants, Level, VoidError, solve
from noack.theory.gains import Coefficients, ErrorGains, Output, PlantGains
from tests.noack.theory.loops import RUNS, System, networks, simulate, systems

# Simulation and enclosure are both rounded; each error is below this.
ROUNDING = 1 + 1e-9

LOOPS, LOOPS_PER_FAMILY = 320, 9
"""Times RUNS = 25: more than 10,000 simulated runs."""

SEARCH = settings(deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])

seeds = st.integers(0, 2**32)


def exceeded(system: System, certified: Constants, seed: int) -> list[str]:
    """The bounds that some run exceeds."""
    worst = simulate(system, *networks(np.random.default_rng(seed), system)).worst(system)
    shares = worst.shares(certified, system.beta)
    return [name for name, share in shares.items() if share > ROUNDING]


def certified(system: System) -> Constants:
    try:
        return system.certify()
    except VoidError:
        assume(False)
        raise


@settings(SEARCH, max_examples=LOOPS)
@given(systems(), seeds)
def test_no_certified_bound_is_ever_exceeded(system: System, seed: int) -> None:
    assert exceeded(system, certified(system), seed) == []


def test_the_checks_cover_more_than_ten_thousand_runs() -> None:
    assert (LOOPS + LOOPS_PER_FAMILY * len(MUTANTS)) * RUNS >= 10_000


def without_condition(field: str) -> Callable[[System], Constants]:
    return lambda system: system.certify(system.conditions._replace(**{field: 0.0}))


def one_dropout_forgotten(system: System) -> Constants:
    return system.certify(system.conditions._replace(dropouts=system.mansd - 1))


def with_gains(error: type[ErrorGains], plant: type[PlantGains]) -> Callable[[System], Constants]:
    def certify(system: System) -> Constants:
        models = error(system.H, system.K, system.weight, system.alpha)
        side = plant(models, system.A, system.B, system.x0[:, None], system.alpha)
        return solve(models, side, system.conditions, Level(system.beta, system.beta))

    return certify


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
        exact = Coefficients(0.0, 0.0)
        return {**super().states, Output.MISMATCH: exact}


class OnlyTheFirstMoment(ErrorGains):
    """Uses ‖C W^{−1}‖, the value at τ = 0, instead of the supremum over τ."""

    def missing(self, output: Output, events: int, spacing_s: float) -> float:
        return events * self.now(output)


class OnlyTheNewest(ErrorGains):
    """Counts one missing event, whatever their number."""

    def missing(self, output: Output, events: int, spacing_s: float) -> float:
        return super().missing(output, min(events, 1), spacing_s)


class ThresholdStandsStill(ErrorGains):
    """Ignores that an old error was bounded by an earlier, larger threshold."""

    @property
    def scaled_H(self) -> np.ndarray:  # type: ignore[override]
        return self.H


INSTANT = {"sample_steps": 1, "delay_steps": 0, "hold_steps": 0, "step_share": 0.01}

MUTANTS: dict[str, tuple[Callable[[System], Constants], dict[str, Any]]] = {
    "one dropout forgotten": (one_dropout_forgotten, {"mansd": 1, **INSTANT}),
    "the sampling period forgotten": (without_condition("sampling_s"), {"step_share": 0.03}),
    "the delay forgotten": (
        without_condition("delay_s"),
        {"mansd": 0, "delay_steps": 4, "sample_steps": 1, "step_share": 0.03},
    ),
    "the hold forgotten": (
        without_condition("hold_s"),
        {"mansd": 0, "hold_steps": 4, "delay_steps": 0, "beta": 0.01, "step_share": 0.03},
    ),
    "the start forgotten": (
        without_condition("start_s"),
        {"mansd": 0, "hold_steps": 4, "lag_steps": 2, "beta": 0.01, "step_share": 0.03},
    ),
    "no forced response": (with_gains(ErrorGains, NoForcedResponse), {"beta": 1.0}),
    "no free response": (with_gains(ErrorGains, NoFreeResponse), {"beta": 0.01}),
    "no mismatch": (with_gains(ErrorGains, NoMismatch), {"mismatch": 0.5, "beta": 0.01}),
    "only the first moment": (
        with_gains(OnlyTheFirstMoment, PlantGains),
        {"spread": 10.0, "n": 5, "mansd": 2, "alpha_share": 0.8, **INSTANT},
    ),
    "only the newest missing event": (
        with_gains(OnlyTheNewest, PlantGains), {"mansd": 6, **INSTANT},
    ),
    "the threshold stands still": (
        with_gains(ThresholdStandsStill, PlantGains), {"alpha_share": 0.8, "mansd": 4, **INSTANT},
    ),
}  # fmt: skip


@pytest.mark.parametrize("mutant", MUTANTS)
def test_no_bound_is_exceeded_where_a_broken_copy_s_would_be(mutant: str) -> None:
    """Loops in which one effect dominates."""
    _, where = MUTANTS[mutant]

    @settings(SEARCH, max_examples=LOOPS_PER_FAMILY)
    @given(systems(**where), seeds)
    def check(system: System, seed: int) -> None:
        assert exceeded(system, certified(system), seed) == []

    check()


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_broken_copy_is_caught(mutant: str) -> None:
    broken, where = MUTANTS[mutant]

    def caught(case: tuple[System, int]) -> bool:
        system, seed = case
        try:
            return bool(exceeded(system, broken(system), seed))
        except VoidError:
            return False

    find(
        st.tuples(systems(**where), seeds),
        caught,
        settings=settings(SEARCH, max_examples=400, database=None),
    )
