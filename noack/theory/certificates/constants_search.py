"""The search for the constants of some plants: at which rate they decay, and in which phases.

A threshold that is a share of the state allows any rate, of which the best is chosen; another one
has its own, or a slower one where that is too fast. With persistent disturbances there are
constants to be added (``persistent_bounds.py``).
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import (
    CertificatePart,
    Constants,
    NetworkConditions,
    NoCertificateError,
)
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import PlantGains, error_gains, first_equal
from noack.theory.bounds.trigger_bounds import TriggerBounds
from noack.theory.certificates.assumptions import is_below_decay_rate
from noack.theory.certificates.persistent_bounds import DisturbedCertificate, PlantAt, choose_rate
from noack.theory.certificates.solution import Problem, solve_problem

_SLOWER = 0.9
"""Rate that is certified if α is too large, as a share of the decay rate of the loop."""
_SHARES_OF_ALPHA = (0.8, 0.6, 0.4, 0.2)
"""Rates that are tried for a box, as shares of α."""
_TOO_LARGE = "intermediate results are too large or too small for floating point"


class Phases(NamedTuple):
    """The constants of one bound of a run."""

    main: Constants
    floor: Constants | None = None
    """Those from when the threshold has reached its floor."""
    persistent: Constants | None = None
    """Those to be added under persistent disturbances."""


class ConstantsSearch:
    """Searches for the constants of a scope's plants, by the rates that its trigger may have.

    Args:
        resolved: the scenario.
        plant_at: returns the plants' gains.
        trigger: what is used of the scenario's trigger.
        start: x(0), or a matrix that maps the unit ball to a set of x(0), (n, k).
        start_error: sup‖u − Kx‖, scaled, until the first input of the controller; 0: as bounds assume.
        decay_per_s: the smaller decay rate of the models and of A + BK.
    """

    def __init__(
        self,
        resolved: Scenario,
        plant_at: PlantAt,
        trigger: TriggerBounds,
        start: Matrix,
        start_error: float,
        decay_per_s: float,
    ) -> None:
        self._resolved, self._loop, self._trigger = resolved, loop_of(resolved), trigger
        self._plant_at, self._start, self._start_error = plant_at, start, start_error
        self._decay_per_s = decay_per_s
        # Where events have a due time, a missed update is missed for a limited time.
        self._models_are_constant = not self._loop.H.any() and not trigger.has_due_time
        self._plants: dict[float, PlantGains] = {}

    @property
    def is_simple(self) -> bool:
        """Whether nothing persists whose bounds are added to those from the start."""
        return self._resolved.coverage.is_undisturbed and not self._trigger.is_constant

    def phases(self, conditions: NetworkConditions, *, longest: bool) -> list[Phases]:
        """Return the constants that solve the inequalities.

        ``longest``: search for the tightest bounds and the longest δ; otherwise any suffice.
        """
        try:
            if self.is_simple:
                return [self._simple_phases(conditions, longest=longest)]
            return self._disturbed_phases(conditions, longest=longest)
        except (OverflowError, np.linalg.LinAlgError):
            raise NoCertificateError(_TOO_LARGE) from None

    def without_decay(self, conditions: NetworkConditions) -> list[Phases]:
        """Return constants of bounds without decay.

        Raises:
            NoCertificateError, NotDecayingError: there are none.
        """
        if not self.is_simple:
            pairs = self._disturbed.constants(conditions, decays=False, longest=False)
            return [self._checked(Phases(main, persistent=added)) for main, added in pairs]
        trigger = self._trigger
        level = 0.0 if trigger.is_homogeneous else max(trigger.beta, trigger.floor)
        tested, least_level = trigger.conditions_of_tests(conditions), trigger.floor or None
        constants = self._solve(tested, 0.0, level, least_level, longest=False)
        return [self._checked(Phases(constants))]

    def with_plants(self, phases: Phases) -> Sequence[tuple[PlantGains, Constants]]:
        """Return the constants to be added, each with the plants' gains at its rate."""
        if self.is_simple:
            return [(self._plants[phases.main.rate_per_s], phases.main)]
        return self._disturbed.with_plants(phases.main, phases.persistent)

    def _simple_phases(self, conditions: NetworkConditions, *, longest: bool) -> Phases:
        """Return the constants, and those after the threshold has reached its floor, if any."""
        trigger, floor = self._trigger, None
        conditions = trigger.conditions_of_tests(conditions)
        main = self._first_phase(conditions, longest=longest)
        if 0 < trigger.floor < trigger.beta and main.rate_per_s == trigger.alpha_per_s:
            floor = _at_floor(main, trigger.floor / trigger.beta)
        return self._checked(Phases(main, floor))

    def _disturbed_phases(self, conditions: NetworkConditions, *, longest: bool) -> list[Phases]:
        """Return the constants, and those to be added under persistent disturbances."""
        alpha = self._trigger.alpha_per_s
        decays = not self._models_are_constant and is_below_decay_rate(alpha, self._decay_per_s)
        pairs = self._disturbed.constants(conditions, decays=decays, longest=longest)
        return [self._checked(Phases(main, persistent=added)) for main, added in pairs]

    @cached_property
    def _disturbed(self) -> DisturbedCertificate:
        return DisturbedCertificate(
            self._resolved, self._plant_at, self._trigger, self._start_error, self._decay_per_s
        )

    def _checked(self, phases: Phases) -> Phases:
        """Return the constants.

        Raises:
            NoCertificateError: they do not cover the inputs at the start, or are not finite.
        """
        if phases.main.input_error < self._start_error:
            raise NoCertificateError(
                f"at its start the input was {self._start_error:.3g} from Kx; a certificate "
                f"covers at most {phases.main.input_error:.3g}"
            )
        for constants in phases:
            if constants is not None and not _is_finite(constants):
                raise NoCertificateError(_TOO_LARGE)
        return phases

    def _first_phase(self, conditions: NetworkConditions, *, longest: bool) -> Constants:
        trigger, decay = self._trigger, self._decay_per_s
        beta, alpha, floor = trigger.beta, trigger.alpha_per_s, trigger.floor
        if trigger.is_homogeneous:
            if not longest:
                with contextlib.suppress(NoCertificateError):
                    return self._solve(conditions, 0.0, 0.0, None, longest=False)
            return self._fastest(conditions, decay)
        if not self._models_are_constant and is_below_decay_rate(alpha, decay) and floor < beta:
            try:
                return self._solve(conditions, alpha, beta, beta, longest=longest)
            except NotDecayingError:
                if floor > 0:
                    raise
                return self._slower(conditions, alpha)
        # Certify a slower decay or none; the smallest event level is then the floor, if any.
        slower = 0.0 if self._models_are_constant or floor > 0 else max(_SLOWER * decay, 0.0)
        level = max(beta, floor)
        return self._solve(conditions, slower, level, floor or None, longest=longest)

    def _fastest(self, conditions: NetworkConditions, decay: float) -> Constants:
        """Return the constants of bounds for a threshold that is a share of the state, at any rate.

        Raises:
            NoCertificateError: there are no bounds, not even without decay.
        """

        def at_rate(rate_per_s: float) -> tuple[Constants]:
            return (self._solve(conditions, rate_per_s, 0.0, None),)

        # Inputs of an earlier run are bounded without a rate.
        if not self._models_are_constant and 0 < decay < math.inf and self._start_error == 0.0:
            with contextlib.suppress(NotDecayingError, NoCertificateError):
                (constants,) = choose_rate(at_rate, decay, self._loop.x0, self._start)
                return constants
        return self._solve(conditions, 0.0, 0.0, None)

    def _slower(self, conditions: NetworkConditions, alpha_per_s: float) -> Constants:
        """Return bounds that decay more slowly than the threshold, for a box too large for α.

        Raises:
            NotDecayingError: there are no such bounds.
        """
        for share in _SHARES_OF_ALPHA[:-1]:
            rate = share * alpha_per_s
            with contextlib.suppress(NotDecayingError):
                return self._solve(conditions, rate, self._trigger.beta, None)
        return self._solve(conditions, _SHARES_OF_ALPHA[-1] * alpha_per_s, self._trigger.beta, None)

    def _solve(
        self,
        conditions: NetworkConditions,
        alpha_per_s: float,
        level: float,
        least_level: float | None,
        *,
        longest: bool = True,
    ) -> Constants:
        if alpha_per_s not in self._plants:
            error = error_gains(self._loop, alpha_per_s)
            plant = self._plant_at(error, self._start, alpha_per_s)
            plant = replace(plant, further_outputs=self._trigger.outputs)
            self._plants[alpha_per_s] = first_equal(plant)
        plant = self._plants[alpha_per_s]
        part = CertificatePart(plant.error, plant, self._trigger.bound(conditions, level, least_level))
        (constants,) = solve_problem(Problem((part,), conditions, self._start_error, longest))
        return constants


_BOUNDS = (
    "input_error",
    "state",
    "state_weighted",
    "mismatch",
    "received_input_error",
    "present_input_error",
)
"""Constants that bound a signal themselves, not in units of the threshold."""


def _at_floor(constants: Constants, share: float) -> Constants:
    """Return the constants from the floor on, ``share`` = ε/β.

    With θ(t) = max(βe^{−αt}, ε) in place of βe^{−αt}, all bounds of the first phase hold at all
    times: for s ≤ t, θ(s) ≤ θ(t) e^{α(t−s)}, which is all that their proof uses of βe^{−αt}.
    """
    names = ("start_error", *_BOUNDS)
    return constants._replace(rate_per_s=0.0, **{name: share * getattr(constants, name) for name in names})


def _is_finite(constants: Constants) -> bool:
    """Return whether every constant is finite; only the inter-event time may be infinite."""
    numbers = [v for v in constants._replace(inter_event_s=None) if v is not None]
    return all(map(math.isfinite, numbers)) and not math.isnan(constants.inter_event_s or 0.0)
