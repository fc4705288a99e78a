"""The candidates of a design: families of loops with a gain and a norm, each with α and β.

The gains and norms among which a design chooses are at the end.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.analysis.mean_cost import require_weight
from cosim.studies.regulator import lqr_gain
from netem.core.errors import CallerError
from netem.core.number_format import to_digits
from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.settings.values import MatrixRows
from noack.theory.response_bounds import NotDecayingError
from noack.theory.trigger_norm import input_norm

RATE_STEP, RATE_STEPS, MOST_RATE = 1.5, 6, 0.95
"""α of the grid: MOST_RATE of the decay rate, divided by powers of RATE_STEP; RATE_STEPS values."""
LEVELS = np.geomspace(0.01, 3.0, 8)
"""β of the grid, as shares of ‖x(0)‖."""
LEVEL_STEP = float(LEVELS[1] / LEVELS[0])
_WIDEST_RATIO = 3.0
"""Factor by which the search may exceed the grid's range of β."""
_MOST_DIGITS_APART = 12
"""Of the largest weights of Q and R; further apart, a Riccati equation without a solution is theirs."""


class TriggerCandidate(NamedTuple):
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

    def with_trigger(self, candidate: TriggerCandidate) -> Scenario:
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

    def grid(self) -> Iterator[TriggerCandidate]:
        """Return the first candidates of the search."""
        for family, decay_per_s in enumerate(self.decay_per_s):
            for step, level in itertools.product(range(RATE_STEPS), LEVELS):
                alpha_per_s = MOST_RATE * decay_per_s / RATE_STEP**step
                candidate = TriggerCandidate(family, alpha_per_s, float(level) * self.initial_norm)
                if self.contains(candidate):
                    yield candidate

    def neighbours(self, centre: TriggerCandidate, share: float) -> Iterator[TriggerCandidate]:
        """Return a candidate's neighbours, at a distance of this share of the grid's steps."""
        family, alpha_per_s, beta = centre
        for i, j in itertools.product((-share, 0, share), repeat=2):
            candidate = TriggerCandidate(family, alpha_per_s * RATE_STEP**i, beta * LEVEL_STEP**j)
            if (i or j) and self.contains(candidate):
                yield candidate

    def contains(self, candidate: TriggerCandidate) -> bool:
        """Whether a candidate is within the ranges."""
        low = max(LEVELS[0] * self.initial_norm / _WIDEST_RATIO, self.floor)
        high = LEVELS[-1] * self.initial_norm * _WIDEST_RATIO
        slow = candidate.alpha_per_s < self.decay_per_s[candidate.family]
        return slow and low < candidate.beta < high


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
    normed = tuple(Family(gain, weight, scenario) for (gain, weight), scenario in families.items())
    first = normed[0].scenario
    initial_norm = math.hypot(*first.plant.initial_state)
    if initial_norm == 0:
        raise CallerError("plant.initial_state: is 0, but a loop settles to a share of ‖x(0)‖; give another")
    floor, highest = first.decaying.floor, float(LEVELS[-1]) * initial_norm
    if floor >= highest:
        raise CallerError(
            f"trigger.floor = {floor:g}: must be less than the largest β that is tried, "
            f"{LEVELS[-1]:g} ‖x(0)‖ = {highest:g}"
        )
    rates = tuple(decay_rate(family.scenario) for family in normed)
    return DesignSpace(normed, rates, initial_norm, floor)


NORMS = ("identity", "given", "input")
"""Of the trigger: Euclidean, the scenario's, and one that counts errors by
what they do to the input."""
COSTS_OF_INPUT = (0.1, 1.0, 10.0)
"""Factors of R: three regulators, from large to small inputs."""


def families_of(
    scenario: Scenario,
    norms: Sequence[str],
    lqr: tuple[Matrix, Matrix] | None,
) -> dict[tuple[str, str], Scenario]:
    """Return scenarios by the names of gain and norm.

    With ``lqr`` (Q and R) the gains are those of regulators, one for each of
    :data:`COSTS_OF_INPUT`; otherwise the gain is the scenario's.

    Raises:
        CallerError: a norm or a gain cannot be computed.
    """
    if not norms:
        raise CallerError(f"--weights: name at least one of {', '.join(NORMS)}")
    gains = {"given": scenario} if lqr is None else dict(_with_regulators(scenario, *lqr))
    scenarios = {}
    for gain, regulated in gains.items():
        for norm in norms:
            scenarios[gain, norm] = _with_norm(regulated, norm)
    return scenarios


def _with_regulators(scenario: Scenario, Q: Matrix, R: Matrix) -> list[tuple[str, Scenario]]:
    """Return the scenario with each regulator, by name."""
    loop = loop_of(resolve(scenario))
    for name, matrix, size in (("--Q", Q, loop.n), ("--R", R, loop.m)):
        if matrix.shape != (size, size):
            raise CallerError(f"{name}: expected {size} x {size}, or {size} numbers for its diagonal")
    scenarios = []
    for cost in COSTS_OF_INPUT:
        K = weighed_gain(loop.A_model, loop.B_model, Q, cost * R)
        model = scenario.model.model_copy(update={"gain": tuple(map(tuple, K.tolist()))})
        scenarios.append((f"lqr R × {cost:g}", scenario.model_copy(update={"model": model})))
    return scenarios


def round_gain(K: Matrix) -> MatrixRows:
    """Return a gain with six digits: what is certified is what is printed."""
    return tuple(tuple(to_digits(entry, 6) for entry in row) for row in K.tolist())


def weighed_gain(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Return the gain of a regulator, (m, n), see :func:`lqr_gain`.

    Raises:
        CallerError: Q or R is not a valid weight, the sizes of both are too different, or no P makes
            the loop stable.
    """
    require_weight("--Q", Q)
    require_weight("--R", R, definite=True)
    with suppress(np.linalg.LinAlgError):
        return lqr_gain(A, B, Q, R)
    sizes = np.log10([np.abs(weight).max() or 1.0 for weight in (Q, R)])
    if abs(sizes[1] - sizes[0]) > _MOST_DIGITS_APART:
        raise CallerError(
            "--R: its weights and those of --Q are too different in size: the Riccati equation has no "
            "stabilising solution in double precision"
        )
    raise CallerError(
        "model: its Riccati equation has no stabilising solution; "
        "every unstable mode must be within the inputs' reach and weighed by Q"
    )


def _with_norm(scenario: Scenario, norm: str) -> Scenario:
    """Return the scenario with a norm of its trigger, one of :data:`NORMS`."""

    def with_norm(rows: tuple[tuple[float, ...], ...] | None) -> Scenario:
        trigger = scenario.decaying.model_copy(update={"weight": rows})
        return scenario.model_copy(update={"trigger": trigger})

    if norm == "identity":
        return with_norm(None)
    if norm == "given":
        if scenario.decaying.weight is None:
            raise CallerError("--weights given: the scenario has no trigger.weight")
        return scenario
    if norm != "input":
        raise CallerError(f'--weights: {", ".join(NORMS)}, not "{norm}"')
    if scenario.mode == "zoh":
        raise CallerError("--weights input: models that hold do not decay; take --weights identity")
    # α in the middle of the grid: a norm that contracts at this rate does so at all lower rates.
    loop, rate_per_s = loop_of(resolve(scenario)), MOST_RATE * decay_rate(scenario) / RATE_STEP
    try:
        weight = input_norm(loop.H, loop.K, rate_per_s)
    except NotDecayingError as error:
        raise CallerError(f"--weights input: {error}") from None
    return with_norm(tuple(map(tuple, weight.tolist())))
