"""The candidates of a design: families of loops with a gain and a norm, each with α and β."""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, spectral_abscissa

RATE_STEP, RATE_STEPS, MOST_RATE = 1.5, 6, 0.95
"""α of the grid: MOST_RATE of the decay rate, divided by powers of RATE_STEP; RATE_STEPS values."""
LEVELS = np.geomspace(0.01, 3.0, 8)
"""β of the grid, as shares of ‖x(0)‖."""
LEVEL_STEP = float(LEVELS[1] / LEVELS[0])
_WIDEST = 3.0
"""Factor by which the search may exceed the grid's range of β."""


class Candidate(NamedTuple):
    """A trigger of a family."""

    family: int
    alpha_per_s: float
    beta: float


@dataclass(frozen=True)
class Family:
    """Candidates that differ in α and β only."""

    gain: str
    """Name of the gain."""
    weight: str
    """Name of the norm."""
    scenario: Scenario
    """The scenario with this gain and norm, not resolved."""

    @property
    def name(self) -> str:
        """The names of norm and gain."""
        return self.weight if self.gain == "given" else f"{self.weight}, {self.gain}"

    def with_trigger(self, candidate: Candidate) -> Scenario:
        """Return the scenario of a candidate."""
        trigger = self.scenario.decaying.model_copy(
            update={"alpha_per_s": candidate.alpha_per_s, "beta": candidate.beta}
        )
        return self.scenario.model_copy(update={"trigger": trigger})


@dataclass(frozen=True)
class DesignSpace:
    """All families with their ranges of α and β."""

    families: tuple[Family, ...]
    decay_per_s: tuple[float, ...]
    """The decay rate of each family; α must be below it."""
    initial_norm: float
    """‖x(0)‖."""
    floor: float
    """Floor of the trigger; β must be above it."""

    def grid(self) -> Iterator[Candidate]:
        """Return the first candidates of the search."""
        for family, decay_per_s in enumerate(self.decay_per_s):
            for step, level in itertools.product(range(RATE_STEPS), LEVELS):
                alpha_per_s = MOST_RATE * decay_per_s / RATE_STEP**step
                one = Candidate(family, alpha_per_s, float(level) * self.initial_norm)
                if self.contains(one):
                    yield one

    def around(self, centre: Candidate, share: float) -> Iterator[Candidate]:
        """Return a candidate's neighbours, at a distance of this share of the grid's steps."""
        family, alpha_per_s, beta = centre
        for i, j in itertools.product((-share, 0, share), repeat=2):
            one = Candidate(family, alpha_per_s * RATE_STEP**i, beta * LEVEL_STEP**j)
            if (i or j) and self.contains(one):
                yield one

    def contains(self, one: Candidate) -> bool:
        """Whether a candidate is within the ranges."""
        low = max(LEVELS[0] * self.initial_norm / _WIDEST, self.floor)
        high = LEVELS[-1] * self.initial_norm * _WIDEST
        return one.alpha_per_s < self.decay_per_s[one.family] and low < one.beta < high


def with_gain(scenario: Scenario, K: Matrix) -> Scenario:
    """Return the scenario with another gain, (m, n)."""
    model = scenario.model.model_copy(update={"gain": tuple(map(tuple, K.tolist()))})
    return scenario.model_copy(update={"model": model})


def with_norm(scenario: Scenario, weight: Matrix | None) -> Scenario:
    """Return the scenario with another norm in the trigger, W or the identity."""
    rows = None if weight is None else tuple(map(tuple, weight.tolist()))
    trigger = scenario.decaying.model_copy(update={"weight": rows})
    return scenario.model_copy(update={"trigger": trigger})


def decay_rate(scenario: Scenario) -> float:
    """Return the limit of α, per second: the decay rate of the nominal loop and the models.

    Raises:
        CallerError: the nominal loop does not decay.
    """
    loop = loop_of(resolve(scenario))
    rate = -spectral_abscissa(loop.A_model + loop.B_model @ loop.K)
    if rate <= 0:
        raise CallerError("model.gain: the nominal loop is not stable; --gain lqr chooses another")
    return rate


def space_of(families: Mapping[tuple[str, str], Scenario]) -> DesignSpace:
    """Return the space of scenarios, which are given by the names of gain and norm.

    Raises:
        CallerError: ‖x(0)‖ = 0, the floor is above all β, or a nominal loop does not decay.
    """
    found = tuple(Family(gain, weight, one) for (gain, weight), one in families.items())
    first = found[0].scenario
    initial_norm = math.hypot(*first.plant.initial_state)
    if initial_norm == 0:
        raise CallerError(
            "plant.initial_state: is 0, but a loop settles to a share of ‖x(0)‖; give another"
        )
    floor, highest = first.decaying.floor, float(LEVELS[-1]) * initial_norm
    if floor >= highest:
        raise CallerError(
            f"trigger.floor = {floor:g}: must be less than the largest β that is tried, "
            f"{LEVELS[-1]:g} ‖x(0)‖ = {highest:g}"
        )
    rates = tuple(decay_rate(one.scenario) for one in found)
    return DesignSpace(found, rates, initial_norm, floor)
