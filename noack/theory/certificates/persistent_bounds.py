"""The certificate of a loop with disturbances, noise, an observer or a constant threshold.

For given events all inequalities of a certificate are linear in functions of time, v ≤ T v + g,
with a positive T. So for g = g₁ + g₂, v is at most the sum of both solutions: one for what decays
(the start, βe^{−αt}, the first estimate), scaled by e^{αt}; the other, not scaled, for what
persists (disturbances, noise, the floor ε of the threshold, which is at most βe^{−αt} + ε). Both
use the same δ. An event needs a threshold of at least (βe^{−αt} + ε)/2. If
α is too large, all are bounded together, without decay.
"""

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import (
    CertificatePart,
    Constants,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.disturbances import EstimationError, bound_forcing
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, Forcing, PlantGains, error_gains, first_equal
from noack.theory.bounds.trigger_bounds import TriggerBounds
from noack.theory.certificates.solution import Problem, solve_problem

PlantAt = Callable[[ErrorGains, Matrix, float], PlantGains]
"""Returns the plant's gains from the gains of the models, the start of x, and α."""
_CHORD_ROUNDS = 2
"""Number of rounds that shorten the chord of the threshold by the last bound of x."""
_RATE_SHARES = (0.7, 0.4, 0.2, 0.05)
"""Rates that are tried, as shares of the loop's decay rate."""
ConstantsOfParts = TypeVar("ConstantsOfParts", bound=Sequence[Constants])


class AddedConstants(NamedTuple):
    """Constants whose bounds are added."""

    main: Constants
    """Of what follows from the start."""
    persistent: Constants | None = None
    """Of what persists."""


@dataclass(frozen=True)
class DisturbedCertificate:
    """Computes the constants of a resolved scenario; ``start_error`` as for CertificateScope."""

    resolved: Scenario
    plant_at: PlantAt
    trigger: TriggerBounds
    start_error: float
    slowest_per_s: float
    """The decay rate of the models and of A + BK, the smaller one."""

    def constants(
        self, conditions: NetworkConditions, *, decays: bool, longest: bool = True
    ) -> list[AddedConstants]:
        """Return the constants that decay and those to be added; without decay only one.

        Where there are several such sums, each bounds the run.

        ``decays``: α is below the decay rates of the models and of the plant. ``longest``: search
        for the tightest bounds and the longest δ; otherwise any suffice.

        Raises:
            NoCertificateError: the loop gain is not below 1.
            NotDecayingError: a mode of the loop or of the observer does not decay.
        """
        conditions = self.trigger.conditions_of_tests(conditions)
        # A part that decays as the threshold does, if there is one.
        if decays and self.resolved.coverage.is_decaying:
            try:
                parts = solve_two_parts(
                    self._decaying,
                    self._persistent,
                    conditions,
                    self.start_error,
                    longest=longest,
                )
                return [AddedConstants(*parts)]
            except NotDecayingError:
                pass
        pairs = self._without_decay(conditions, decays=decays, longest=longest)
        # With a bound of x the chord of the threshold is shorter, which makes the bounds smaller.
        for _ in range(_CHORD_ROUNDS if longest and self.trigger.has_chord else 0):
            state_bounds = [
                sum(
                    constants.state_weighted + constants.estimation_error
                    for constants in pair
                    if constants is not None
                )
                for pair in pairs
            ]
            shorter_chord = replace(self.trigger, largest=min(state_bounds))
            sharper = replace(self, trigger=shorter_chord)
            pairs = sharper._without_decay(conditions, decays=decays, longest=longest)
        return pairs

    def _without_decay(
        self, conditions: NetworkConditions, *, decays: bool, longest: bool
    ) -> list[AddedConstants]:
        """Return the constants of a threshold that does not decay, or more slowly than the loop.

        Raises: as :meth:`constants`.
        """
        level, floor = max(self.trigger.beta, self.trigger.floor), self.trigger.floor
        bound = self.trigger.bound(conditions, level, floor or None)
        part = self._undivided._replace(bound=bound)
        (constants,) = solve_problem(Problem((part,), conditions, self.start_error, longest))
        # The mean of an integral bounds e_s over a time that suits only one of several parts.
        is_divided = not self.trigger.beta and not self.trigger.area and not self.start_error
        divided: list[AddedConstants] = []
        if decays and is_divided and longest:
            inter_event_s = constants.inter_event_s or 0.0
            divided = self._of_constant_threshold(conditions, inter_event_s)
        return [*divided, AddedConstants(constants)]

    def with_plants(
        self, decaying: Constants, persistent: Constants | None
    ) -> Sequence[tuple[PlantGains, Constants]]:
        """Return constants of :meth:`constants` with the plants of their parts."""
        if persistent is None:
            decays = decaying.rate_per_s > 0
            plant = self._plant(decaying.rate_per_s) if decays else self._undivided.plant
            return [(plant, decaying)]
        return [(self._plant(decaying.rate_per_s), decaying), (self._persistent.plant, persistent)]

    def _of_constant_threshold(
        self, conditions: NetworkConditions, inter_event_s: float
    ) -> list[AddedConstants]:
        """Return the constants of what follows from the start, and of what persists, if any.

        There is one pair for each bound of e_s that suffices, that with the smallest ultimate bound
        first. The threshold has no rate; that of :func:`choose_rate` is taken. ``inter_event_s`` is a
        lower bound of the inter-event time, certified without dividing into parts.
        """
        pairs: list[AddedConstants] = []
        for start_bound, persistent_bound in self.trigger.divide(conditions, inter_event_s):
            with contextlib.suppress(NoCertificateError, NotDecayingError):
                pairs.append(self._divided(start_bound, persistent_bound, conditions))
        return sorted(pairs, key=lambda pair: 0.0 if pair.persistent is None else pair.persistent.state)

    def _divided(
        self, start_bound: TriggerBound, persistent_bound: TriggerBound, conditions: NetworkConditions
    ) -> AddedConstants:
        """Return the constants that one bound of e_s gives, divided into those of both parts.

        Raises: as :func:`choose_rate`.
        """
        persistent = self._persistent._replace(bound=persistent_bound)
        persists = (
            persistent_bound.beta or persistent.plant.forcing is not None or persistent.estimation.fixed
        )
        persistent_parts = [persistent] if persists else []

        def solve_at(rate_per_s: float) -> list[Constants]:
            return solve_problem(
                Problem((self._at_rate(rate_per_s, start_bound), *persistent_parts), conditions)
            )

        x0 = loop_of(self.resolved).x0
        decaying, *added = choose_rate(solve_at, self.slowest_per_s, x0, x0)
        return AddedConstants(decaying, *added)

    @cached_property
    def _decaying(self) -> CertificatePart:
        return self._at_rate(self.trigger.alpha_per_s, TriggerBound(self.trigger.beta, None))

    def _at_rate(self, rate_per_s: float, bound: TriggerBound) -> CertificatePart:
        """Return the part that follows from the start, scaled by a rate."""
        plant = self._plant(rate_per_s)
        return CertificatePart(plant.error, plant, bound, self._estimation.decaying(rate_per_s))

    @cached_property
    def _persistent(self) -> CertificatePart:
        plant = self._disturbed_plant
        at_rest = replace(plant, start=np.zeros_like(plant.start))
        bound = TriggerBound(self.trigger.floor, None, unit=1.0)
        return CertificatePart(plant.error, at_rest, bound, self._estimation.persistent())

    @cached_property
    def _undivided(self) -> CertificatePart:
        """Everything without decay; the trigger's bound depends on the conditions."""
        decaying, persistent = self._estimation.decaying(0.0), self._estimation.persistent()
        estimation = persistent._replace(fixed=persistent.fixed + decaying.fixed)
        plant = self._disturbed_plant
        return CertificatePart(plant.error, plant, TriggerBound(0.0, None), estimation)

    @cached_property
    def _disturbed_plant(self) -> PlantGains:
        """The plant without decay, with its disturbances if it has any."""
        plant = self._plant(0.0)
        forcing = self._forcing(plant)
        return plant if forcing is None else replace(plant, forcing=forcing)

    def _plant(self, alpha_per_s: float) -> PlantGains:
        loop = loop_of(self.resolved)
        plant = self.plant_at(error_gains(loop, alpha_per_s), loop.x0[:, None], alpha_per_s)
        outputs = {**self._estimation.further_outputs, **self.trigger.outputs}
        return first_equal(replace(plant, further_outputs=outputs))

    def _forcing(self, plant: PlantGains) -> Forcing | None:
        return bound_forcing(self.resolved, plant.B)

    @cached_property
    def _estimation(self) -> EstimationError:
        """The estimation error of the plant."""
        loop = loop_of(self.resolved)
        models = error_gains(loop, 0.0)
        plant = self.plant_at(models, loop.x0[:, None], 0.0)
        assert plant.is_one_plant or self.resolved.observer is None  # others are refused
        return EstimationError(self.resolved, plant.A, plant.B, self._forcing(plant))


def solve_two_parts(
    decaying: CertificatePart,
    persistent: CertificatePart,
    conditions: NetworkConditions,
    earlier_error: float = 0.0,
    *,
    longest: bool = True,
) -> tuple[Constants, Constants]:
    """Return the constants of both parts.

    Without ``longest`` δ is searched for only if there is no certificate otherwise.

    Raises:
        NoCertificateError: the loop gain of one part is not below 1.
        NotDecayingError: a mode of the loop decays more slowly than a part's bounds.
    """
    if persistent.bound.beta > 0:  # an event needs half of one of the thresholds
        decaying, persistent = (
            part._replace(bound=part.bound._replace(least_event_error=part.bound.beta / 2))
            for part in (decaying, persistent)
        )
    first_constants, second_constants = solve_problem(
        Problem((decaying, persistent), conditions, earlier_error, longest)
    )
    return first_constants, second_constants


def choose_rate(
    solve_at: Callable[[float], ConstantsOfParts],
    decay_per_s: float,
    start: Vector,
    start_set: Matrix,
) -> ConstantsOfParts:
    """Return the constants for a rate, where none is given.

    It is the rate at which the first constants' bound of ‖x‖ falls to ‖x(0)‖/10 first.

    Args:
        solve_at: searches for constants for a rate in 1/s.
        decay_per_s: the decay rate of the loop.
        start: x(0), (n,).
        start_set: x(0), or a matrix that maps the unit ball to a set of x(0), (n, k), that is bounded.

    Raises: what ``solve_at`` raises at the smallest rate.
    """
    start_set_norm = float(np.linalg.norm(start_set, 2))
    best, best_s = None, math.inf
    for share in _RATE_SHARES:
        rate_per_s = share * decay_per_s
        # No bound of ‖x‖ is below its first value, so a small rate is often not worth trying.
        if best is not None and time_to_tenth_s(start_set_norm, rate_per_s, start) > best_s:
            break
        try:
            constants = solve_at(rate_per_s)
        except (NotDecayingError, NoCertificateError):
            if best is None and share == _RATE_SHARES[-1]:
                raise
            continue  # smaller rates have smaller gains
        if best is None or time_to_tenth_s(constants[0].state, rate_per_s, start) <= best_s:
            best, best_s = constants, time_to_tenth_s(constants[0].state, rate_per_s, start)
    assert best is not None
    return best


def time_to_tenth_s(state: float, rate_per_s: float, start: Vector) -> float:
    """Return when a bound of ‖x‖, ``state`` at first, falls to ‖x(0)‖/10."""
    start_norm = float(np.linalg.norm(start)) or 1.0
    return math.log(max(10 * state / start_norm, 1.0)) / rate_per_s
