"""Certificates of a scenario: their constants, assumptions and conditions.

:class:`CertificateScope` is a scenario's own plant, or its uncertainty box.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.scenario.resolution import loop_of, rule_of
from noack.scenario.scenario import Scenario
from noack.settings.section import MatrixRows
from noack.theory.bounds.box import BoxGains
from noack.theory.bounds.certificate_terms import Constants, NetworkConditions, NoCertificateError
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.bounds.trigger_bounds import TriggerBounds
from noack.theory.certificates.assumptions import certificate_assumptions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import BOX, OWN_PLANT, kept_probability
from noack.theory.certificates.constants_search import ConstantsSearch, Phases
from noack.theory.certificates.persistent_bounds import PlantAt
from noack.theory.certificates.refusals import refusal_under

_SMALLEST_START, _LARGEST_START = 1e-150, 1e150
"""The squares of larger entries of x(0) may overflow."""


def trigger_bounds(resolved: Scenario) -> TriggerBounds:
    """Return what a certificate uses of a resolved scenario's trigger."""
    loop = loop_of(resolved)
    weight = np.eye(loop.n) if loop.weight is None else loop.weight
    fastest = float(np.abs(np.linalg.eigvals(loop.A_model + loop.B_model @ loop.K)).max()) or 1.0
    return TriggerBounds(rule_of(resolved), weight, fastest)


def certify(resolved: Scenario, conditions: NetworkConditions) -> ScenarioCertificate:
    """Return the certificate of a scenario's own plant; see :class:`CertificateScope`."""
    return own_plant_scope(resolved).certificate(conditions)


def certify_box(resolved: Scenario, conditions: NetworkConditions) -> ScenarioCertificate | None:
    """Return the certificate of all plants in the scenario's uncertainty box; None if it has none."""
    scope = box_scope(resolved)
    return None if scope is None else scope.certificate(conditions)


def own_plant_scope(resolved: Scenario, start_error: float | None = None) -> "CertificateScope":
    """Return a scenario's own plant."""
    loop = loop_of(resolved)

    def plant_at(error: ErrorGains, start: Matrix, alpha_per_s: float) -> PlantGains:
        return PlantGains(error, loop.A, loop.B, start, alpha_per_s)

    return CertificateScope(OWN_PLANT, resolved, loop.A + loop.B @ loop.K, plant_at, start_error)


def box_scope(resolved: Scenario, start_error: float | None = None) -> "CertificateScope | None":
    """Return all plants in the scenario's uncertainty box; None if it has none."""
    loop, plant = loop_of(resolved), resolved.plant
    if plant.uncertainty_A is None and plant.uncertainty_B is None:
        return None
    half_A, half_B = _halfwidth(plant.uncertainty_A, loop.A), _halfwidth(plant.uncertainty_B, loop.B)

    def plant_at(error: ErrorGains, start: Matrix, alpha_per_s: float) -> PlantGains:
        return BoxGains(error, loop.A_model, loop.B_model, start, alpha_per_s, half_A, half_B)

    closed_loop = loop.A_model + loop.B_model @ loop.K
    return CertificateScope(BOX, resolved, closed_loop, plant_at, start_error)


def outside_box(resolved: Scenario) -> str | None:
    """Return, as text, an entry of the plant outside its uncertainty box; None if there is none."""
    loop, plant = loop_of(resolved), resolved.plant
    if plant.uncertainty_A is None and plant.uncertainty_B is None:
        return None
    for name, true, model, rows in (
        ("A", loop.A, loop.A_model, plant.uncertainty_A),
        ("B", loop.B, loop.B_model, plant.uncertainty_B),
    ):
        half = _halfwidth(rows, true)
        slack = 1e-12 * (1.0 + np.abs(model))
        for i, j in np.argwhere(np.abs(true - model) > half + slack):
            distance = abs(true[i, j] - model[i, j])
            return (
                f"the plant lies outside: {name}[{i + 1}, {j + 1}] is {distance:.3g} from the "
                f"model's, the half-width is {half[i, j]:.3g}"
            )
    return None


def _halfwidth(rows: MatrixRows | None, matrix: Matrix) -> Matrix:
    return np.zeros_like(matrix) if rows is None else np.array(rows)


class CertificateScope:
    """Plants for which certificates are computed; values without conditions are computed once.

    Args:
        name: name of the plants.
        resolved: the scenario.
        closed_loop: A + BK, for a box that of its centre, (n, n).
        plant_at: returns the plants' gains.
        start_error: sup‖u − Kx‖, scaled, until the first input of the controller, at a set-point
            whose u_r is not the 0 that the plant applies at first. The certificate exists only if
            its own π is at least that large, so that it covers these inputs. Infinite: they are not
            in the range of K. None: the input is 0 there, as bounds assume.
        start: x(0), or a matrix that maps the unit ball to a set of x(0), (n, k); by default that
            of the scenario.
    """

    def __init__(
        self,
        name: str,
        resolved: Scenario,
        closed_loop: Matrix,
        plant_at: PlantAt,
        start_error: float | None = None,
        start: Matrix | None = None,
    ) -> None:
        self._start_error = start_error or 0.0
        self.name = name
        self.has_observer = resolved.observer is not None
        self._resolved = resolved
        self._loop = loop_of(resolved)
        self._start = self._loop.x0[:, None] if start is None else start
        self._trigger = trigger_bounds(resolved)
        is_limited = not self._loop.H.any() or self._trigger.has_due_time
        decays = math.inf if is_limited else -spectral_abscissa(self._loop.H)
        self.decay_per_s = {"the models": decays, "A + BK": -spectral_abscissa(closed_loop)}
        """Decay rates; that of the models is infinite if they are constant."""
        self._plant_at = plant_at
        self._constants = ConstantsSearch(
            resolved,
            plant_at,
            self._trigger,
            self._start,
            self._start_error,
            min(self.decay_per_s.values()),
        )
        assert start is None or self._constants.is_simple  # other starts are those of the scenario

    @property
    def test_times_s(self) -> list[float]:
        """Times of the trigger's rule after which the first measurement has a test."""
        rule = self._trigger.rule
        times_ns = (rule.grid_ns, rule.idle_ns, rule.longest_ns)
        return [t_ns / NS_PER_S for t_ns in times_ns if 0 < t_ns < math.inf]

    @np.errstate(all="ignore")
    def certificate(
        self, conditions: NetworkConditions, *, knows_delay: bool = False, knows_inputs: bool = False
    ) -> ScenarioCertificate:
        """Return the certificate under some conditions; a void certificate has the reason.

        ``knows_delay``, ``knows_inputs``: as for :func:`refusal_under`.
        """
        # The constants, or the reason for having none.
        void: NotDecayingError | NoCertificateError | None = None
        phases: Sequence[tuple[Constants | None, ...]] = [(None, None, None)]
        why = refusal_under(
            conditions,
            self._resolved,
            self.name,
            knows_delay=knows_delay,
            knows_inputs=knows_inputs,
            start_error=self._start_error,
        )
        try:
            if why is not None:
                raise NoCertificateError(why)
            self._require_normal_start()
            phases = self.all_phases(conditions)
        except (NotDecayingError, NoCertificateError) as error:
            void = self._overflow() or error
        unchecked = self._with_constants(phases, conditions, None if void is None else str(void))
        # The assumptions under which they hold.
        main, persistent = unchecked.constants, unchecked.persistent_constants
        probability = None
        if not self._resolved.network.enforce_mansd:
            probability = kept_probability(self._resolved, conditions.guarantee, unchecked.inter_event_s)
        gains = [phase.loop_gain for phase in (main, persistent) if phase is not None]
        assumptions = certificate_assumptions(
            self._resolved,
            conditions,
            decay_per_s=self._decay_under(conditions),
            constants=main,
            void=void,
            loop_gain=max(gains, default=0.0),
            trigger_bound=self._trigger.text(),
            probability=probability,
        )
        return replace(unchecked, assumptions=tuple(assumptions))

    def _with_constants(
        self,
        phases: Sequence[tuple[Constants | None, ...]],
        conditions: NetworkConditions,
        void: str | None,
    ) -> ScenarioCertificate:
        """Return the certificate of the first phase, with those of the others; no assumptions yet."""
        (main, floor, persistent), *others = phases
        return ScenarioCertificate(
            scope=self.name,
            beta=self._trigger.beta,
            alpha_per_s=self._trigger.alpha_per_s,
            floor=self._trigger.floor,
            weighted=self._loop.weight is not None,
            conditions=conditions,
            assumptions=(),
            constants=main,
            floor_constants=floor,
            void=void,
            persistent_constants=persistent,
            other=self._with_constants(others, conditions, void) if others else None,
        )

    def _require_normal_start(self) -> None:
        """Raise NoCertificateError if x(0) is not 0 and its squares are too small for floating point."""
        largest = float(np.abs(self._loop.x0).max())
        if 0 < largest < _SMALLEST_START:
            raise NoCertificateError(
                "plant.initial_state is too small for floating point: the largest entry of x(0) is "
                f"{largest:.3g}; bounds are computed from {_SMALLEST_START:g} on, and for 0"
            )

    def _overflow(self) -> NoCertificateError | None:
        """Return the reason for having no certificate if x(0) is too large."""
        largest = float(np.abs(self._loop.x0).max())
        if largest <= _LARGEST_START:
            return None
        return NoCertificateError(
            f"plant.initial_state is too large for floating point: an entry of x(0) is {largest:g}; "
            f"bounds are computed up to {_LARGEST_START:g}"
        )

    @np.errstate(all="ignore")
    def loop_gain(self, conditions: NetworkConditions) -> float:
        """Return the loop gain of a certificate; at least 1, perhaps infinite, if there is none."""
        if refusal_under(conditions, self._resolved, self.name, knows_delay=True) is not None:
            return math.inf
        # Whether the first inputs at a set-point are covered depends on the constants.
        try:
            constants = self._constants.phases(conditions, longest=self._start_error > 0)
        except NoCertificateError as error:
            return max(error.loop_gain, 1.0)
        except NotDecayingError:
            return math.inf
        return max(phase.loop_gain for phase in constants[0] if phase is not None)

    def _decay_under(self, conditions: NetworkConditions) -> Mapping[str, float]:
        """Return the decay rates of the certificate under some conditions."""
        return self.decay_per_s

    def all_phases(self, conditions: NetworkConditions) -> list[Phases]:
        """Return the constants of each bound of the run; all of them hold.

        Raises:
            NoCertificateError: there is no certificate.
            NotDecayingError: a mode of the loop decays too slowly.
        """
        return self._constants.phases(conditions, longest=True)
