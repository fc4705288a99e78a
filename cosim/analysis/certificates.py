"""All certificates of a scenario: as one object, as JSON, and as rows of a table."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cosim.analysis.allowed_errors import ThresholdTrials
from cosim.analysis.constant_rows import constant_rows, covered_plants
from cosim.analysis.tried_settings import TriedSettings, helpful_box, helpful_settings, largest_settings
from cosim.analysis.witnesses import Unproven, Witnesses, find_region_witnesses, find_witnesses
from noack.core.errors import CallerError, one_line
from noack.core.linear_systems import Matrix
from noack.core.number_checks import one_of, whole_number
from noack.core.number_format import TextRows, as_html, as_text
from noack.plants.linear import LinearSettings
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.bounds.enclosure import NotDecayingError, norm_bounds, response
from noack.theory.bounds.gains import error_gains, sum_of_sups
from noack.theory.certificates.assumptions import assumptions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import (
    BOX,
    LINEAR_EQUATIONS,
    OWN_PLANT,
    REGION,
    about_reference,
    ideal_conditions,
    jump_s,
    nominal_conditions,
)
from noack.theory.certificates.network_limits import NetworkLimits, network_limits
from noack.theory.certificates.output_bounds import OutputBound, output_bounds
from noack.theory.certificates.plant_equations import LinearEquations, linear_plant
from noack.theory.certificates.proven_bounds import ProvenBounds
from noack.theory.certificates.refusals import refusal_under, refusals_about_reference
from noack.theory.certificates.region import RegionScope
from noack.theory.certificates.scenario_certificates import box_scope, outside_box, own_plant_scope
from noack.theory.certificates.trigger_weight import choose_weight
from noack.theory.coverage import NOT_COVERED, refusals, require_certifiable, without_loads
from noack.theory.paper import Theorem2, theorem_2
from noack.theory.witnesses.effort import MOST_WORK
from noack.theory.witnesses.loss_margin import LossMargin, Stability
from noack.trigger_policies.decaying import DecayingSettings
from noack.trigger_policies.periodic_trigger import PeriodicSettings

IDEAL = "paper"
"""The paper's conditions: no sampling, no delay, no hold."""
SCHEDULE = "schedule"
"""The scenario's rates, and the lateness that it allows."""

MOST_LATE = 1000
"""Most steps of lateness that may be allowed."""
_STATED = {(IDEAL, OWN_PLANT): ("own", "ideal"), (IDEAL, BOX): ("box", "ideal"),
           (SCHEDULE, OWN_PLANT): ("own", "schedule"), (SCHEDULE, BOX): ("box", "schedule"),
           **{(under, scope): ("region", conditions) for scope in (REGION, LINEAR_EQUATIONS)
              for under, conditions in ((IDEAL, "ideal"), (SCHEDULE, "schedule"))}}  # fmt: skip
"""Plants and conditions of witnesses, by those of certificates."""


class CertificateAnswer(NamedTuple):
    """Whether a scenario's own plant has a certificate for the scenario's schedule."""

    is_certified: bool
    text: str
    """Which plants are certified, or why the scenario's own plant is not."""


class Certificates:
    """The certificates of a scenario's plant, and of all plants in its uncertainty box.

    A certificate has ``constants``, or None with the reason in ``void``. It has ``conditions`` on
    network and schedule, which it assumes, and ``assumptions``, each with its verdict. It has
    ``inter_event_s``, the minimum inter-event time δ̲, and three bounds as functions of time in
    seconds: ``sensor_error``, ``controller_error`` and ``state``. The constants include ``delta``,
    Δ of ‖e_c‖ ≤ Δβe^(−αt), ``state``, X of ‖x‖ ≤ Xe^(−αt), and ``rate_per_s``, the decay rate of
    all bounds. ``docs/theory.md`` derives them. They are computed, and not checked. After
    :meth:`prove`, ``proven`` has the bounds that the checker has proven; these are then the ones that
    ``inter_event_s`` and the functions give.

    Iteration yields each certificate with the conditions that it assumes: IDEAL or SCHEDULE.

    >>> import noack
    >>> certificate = noack.certify("double_integrator").schedule
    >>> certificate.state([0.0, 5.0]).shape  # a bound of ‖x(t)‖ for each time
    (2,)

    Args:
        scenario: the resolved scenario.
        late_periods: allowed lateness in steps of the plant.
        weight: W, if noack chose it.
        given: W of the scenario, if it has one and noack chose another.
        nonlinear: the same scenario with its nonlinear plant, certified on a region as well.
        equations: the same scenario with its plant as equations, which are linear: those of ``scenario``.

    Raises:
        CallerError: its updates are acknowledged, its plant or controller is nonlinear, or its
            settings change.
    """

    scenario: Scenario
    """The resolved scenario of the certificates, with the requested weight, about its set-point."""
    setpoint: tuple[float, ...] | None
    """x_r; all bounds of x are those of x − x_r. None: 0."""
    theorem_2: Theorem2 | None
    """Theorem 2 by the paper's formula, with Δ of ``paper``; None if it cannot be evaluated."""
    weight: Matrix | None
    """W of the trigger's norm, (n, n), if this call chose it; else None."""
    late_periods: int
    """Allowed lateness in steps of the plant."""
    nonlinear: str | None = None
    """Why the certificates are for the model as the plant, not for the plant itself; else None."""
    unproven: Sequence[Unproven] = ()
    """Plants and conditions of which nothing is proven, with the reasons."""
    _no_region: str | None = None
    """Why a nonlinear plant has no certificate on a region, if that is known from its settings."""

    def __init__(
        self,
        scenario: Scenario,
        late_periods: int,
        weight: Matrix | None = None,
        given: Matrix | None = None,
        nonlinear: Scenario | None = None,
        equations: Scenario | None = None,
    ) -> None:
        self._arguments = (scenario, late_periods, weight, given, nonlinear, equations)
        self.threshold_advice = dict[str, str]()
        """By output: what brings it within its allowed error, see :meth:`advise`."""
        require_certifiable(without_loads(scenario), "linear", "whole run")
        self.setpoint, void = scenario.controller.setpoint, refusals_about_reference(scenario)
        if OWN_PLANT in void:
            raise CallerError(void[OWN_PLANT])
        self.follows_reference = scenario.controller.reference is not None
        """Whether x is the distance from a reference that changes over time."""
        self.jump_s = jump_s(scenario)
        """When the reference first jumps: the certificates hold until then. None: it does not."""
        scenario = about_reference(scenario, late_periods)
        self.scenario, self.weight, self.late_periods = scenario, weight, late_periods
        self.scheduled = nominal_conditions(scenario, late_periods)
        """The times of the schedule, with its permitted lateness."""
        conditions = {IDEAL: ideal_conditions(scenario), SCHEDULE: self.scheduled}
        own = own_plant_scope(scenario) if equations is None else LinearEquations(equations, scenario)
        scopes = (own, None if BOX in void else box_scope(scenario))
        self._scopes = [scope for scope in scopes if scope is not None]
        if nonlinear is not None:
            self.nonlinear = f'plant.system.kind = "{nonlinear.plant.system.kind}"'
            self._no_region = refusals_about_reference(nonlinear).get(REGION)
            if self._no_region is None and not refusals(nonlinear):
                self._scopes.append(RegionScope(nonlinear))
        self._certificates = [
            (under, scope.certificate(assumed))
            for under, assumed in conditions.items()
            for scope in self._scopes
        ]
        self._own_weight = np.eye(loop_of(scenario).n) if given is None else given
        self.theorem_2 = _theorem_2(scenario, self.paper)

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle what they are computed from, which is computed again, and what is proven."""
        proven = {_STATED.get((under, each.scope)): each.proven for under, each in self if each.proven}
        return Certificates, self._arguments, (proven, self.unproven)

    def __setstate__(self, state: tuple[Mapping[tuple[str, str], ProvenBounds], Sequence[Unproven]]) -> None:
        """Take what is proven."""
        proven, self.unproven = state
        self._certificates = [
            (under, each.with_proof(proven.get(_STATED.get((under, each.scope), ("", "")))))
            for under, each in self
        ]

    def prove(
        self,
        progress: Callable[[float], None] = lambda share: None,
        most_work: float = MOST_WORK,
        conditions: Sequence[str] = ("ideal", "schedule"),
        near: Sequence[Mapping[str, object]] = (),
    ) -> Witnesses:
        """Search for bounds that the checker proves; they take the place of computed ones.

        Args:
            progress: called with the completed share.
            most_work: limit of each search, see :class:`noack.theory.witnesses.effort.Effort`.
            conditions: "ideal" for the paper's conditions, and "schedule" for the scenario's own.
            near: documents of similar scenarios; the search begins near them.
        """
        scenario, late_periods, *_, nonlinear, equations = self._arguments
        if (other := nonlinear or equations) is not None:
            found = find_region_witnesses(other, late_periods, progress, most_work, conditions, near)
        else:
            found = find_witnesses(scenario, late_periods, progress, most_work, conditions, near)
        proven = {(s.plants, s.conditions): s.bounds for s in found.statements if s.bounds is not None}
        self.__setstate__((proven, found.unproven))
        return found

    def advise(self, progress: Callable[[float], None] = lambda share: None) -> None:
        """Search for a smaller threshold for each output whose bound exceeds its allowed error."""
        certificate, scenario = self.guaranteed, self._own_scenario
        if certificate is None or not scenario.coverage.is_linear:
            return
        plants = "box" if certificate.scope == BOX else "own"
        bounds = self.output_bounds(certificate)
        for index, bound in enumerate(bounds):
            if not bound.is_met:
                stated = ThresholdTrials(scenario, self.late_periods, plants)
                self.threshold_advice[bound.output.name] = stated.advice(bound, index, progress)

    def __iter__(self) -> Iterator[tuple[str, ScenarioCertificate]]:
        return iter(self._certificates)

    @property
    def paper(self) -> ScenarioCertificate:
        """Under the paper's conditions: no sampling, no delay and no held input."""
        return self._of(IDEAL)[0]

    @property
    def schedule(self) -> ScenarioCertificate:
        """Under the scenario's own schedule, with its permitted lateness."""
        return self._of(SCHEDULE)[0]

    @property
    def paper_box(self) -> ScenarioCertificate | None:
        """For every plant in the box, under the paper's conditions; None if there is no box."""
        return self._covering(BOX, IDEAL)

    @property
    def schedule_box(self) -> ScenarioCertificate | None:
        """For every plant in the box, under the scenario's schedule; None if there is no box."""
        return self._covering(BOX, SCHEDULE)

    @property
    def schedule_region(self) -> ScenarioCertificate | None:
        """Of a nonlinear plant on its region, under the scenario's schedule."""
        return self._covering(REGION, SCHEDULE)

    @property
    def of_own_plant(self) -> ScenarioCertificate | None:
        """Of the scenario's own plant under its schedule: linear, or nonlinear on its region.

        None if the plant is not linear, and there is no certificate on a region for its settings.
        """
        return self.schedule if self.nonlinear is None else self.schedule_region

    @property
    def guaranteed(self) -> ScenarioCertificate | None:
        """The one with most to say: of all plants within the uncertainty, or of the own plant; None: none."""
        own, box = self.of_own_plant, self.schedule_box
        if box is not None and box.first("state") is not None and outside_box(self.scenario) is None:
            return box
        return own if own is not None and own.first("state") is not None else None

    @property
    def answer(self) -> CertificateAnswer:
        """Whether the scenario's own plant has a certificate for its schedule.

        What is certified for the model of a nonlinear plant is not certified for the plant.
        """
        own = self.of_own_plant
        certified = [c for c in self._of(SCHEDULE) if c.exists and (c.scope != OWN_PLANT or c is own)]
        if own is not None and own.exists:
            plants = " and ".join(certificate.scope for certificate in certified)
            return CertificateAnswer(True, f"certified: {plants}")
        void = self._no_region if own is None else own.void
        reason = f": {void}" if void else ""
        if self.nonlinear is None:
            return CertificateAnswer(False, f"no certificate{reason}")
        model = "; only its model in its place has one" if self.schedule.exists else ""
        return CertificateAnswer(
            False, f"no certificate for the plant, which is not linear ({self.nonlinear}){reason}{model}"
        )

    @property
    def is_proven_stable(self) -> bool:
        """Whether ‖x‖ of the scenario's own plant is proven to have a bound under all losses allowed."""
        if self.answer.is_certified or self.nonlinear is not None:
            return self.answer.is_certified
        return self.stability is not None and self.stability.verdict == "stable"

    @property
    def error_in_given_norm(self) -> float | None:
        """Bound of ‖e_c‖ in the scenario's own norm V, while the trigger uses the chosen W.

        It is that for the schedule, in units of its threshold: errors of events are bounded in the
        trigger's norm, and followed from there by ‖V e^{(H+αI)τ} W^{−1}‖. None if W is the
        scenario's own, if there is no certificate, and under disturbances.
        """
        constants = self.schedule.constants
        if self.weight is None or constants is None or self.schedule.persistent_constants is not None:
            return None
        error = error_gains(loop_of(self.scenario), constants.rate_per_s)
        kernel = response(error.scaled_H, error.inverse_weight).through(self._own_weight)
        present_gain = float(norm_bounds(self._own_weight, error.inverse_weight[None])[0])
        missing = sum_of_sups(kernel, constants.missing_events, constants.inter_event_s or 0.0)
        return min(present_gain * constants.delta, (present_gain + float(missing)) * constants.overshoot)

    @cached_property
    def limits_by_scope(self) -> dict[str, NetworkLimits]:
        """The limits for the plants that have a certificate for the schedule, by the name of the scope.

        They are computed at the first access, from dozens of certificates.
        """
        certified = {each.scope for each in self._of(SCHEDULE) if each.constants is not None}
        return {
            scope.name: network_limits(scope, self.scheduled)
            for scope in self._scopes
            if scope.name in certified
        }

    @cached_property
    def largest_settings(self) -> list[TriedSettings]:
        """Settings with which the scenario's own plant has a certificate, at their largest, each alone."""
        own = self.of_own_plant
        if own is None or own.constants is None:
            return []
        limits = self.limits_by_scope[own.scope]
        return [*largest_settings(self._own_scenario, self.late_periods, limits.delay_s, limits.sampling_s)]

    @cached_property
    def helpful_settings(self) -> list[TriedSettings]:
        """Settings, each of which alone gives the scenario's own plant its missing certificate."""
        own, scenario = self.of_own_plant, self._own_scenario
        if own is None or own.exists:
            return []
        if own.void == refusal_under(self.scheduled, scenario, own.scope, knows_delay=True):
            return []  # whatever the others are
        [scope] = [scope for scope in self._scopes if scope.name == own.scope]
        if scope.decay_per_s["A + BK"] <= 0:  # it is unstable without losses
            return []
        return [*helpful_settings(scenario, self.late_periods)]

    @cached_property
    def helpful_box(self) -> TriedSettings | None:
        """A smaller uncertainty box with its missing certificate, while the plant has one."""
        box = self.schedule_box
        if box is None or box.exists or not self.schedule.exists:
            return None
        return helpful_box(self._own_scenario, self.late_periods)

    @property
    def _own_scenario(self) -> Scenario:
        """The resolved scenario with its own plant."""
        scenario, _, _, _, nonlinear, _ = self._arguments
        return nonlinear or scenario

    @cached_property
    def stability(self) -> Stability | None:
        """What is known about the stability of all loss patterns, if the loop is time-triggered.

        None for other loops, and where the exact margin does not cover the schedule.
        """
        if not isinstance(self.scenario.trigger, PeriodicSettings):
            return None
        with contextlib.suppress(CallerError):
            return LossMargin(self.scenario).first_bounds()
        return None

    def to_json(self) -> dict[str, object]:
        """Return all certificates as one document, as ``noack certify --json`` prints it."""
        return {
            "scenario": self.scenario.name,
            "of_the_model_only": self.nonlinear,
            "setpoint": self.setpoint,
            "weight": None if self.weight is None else self.weight.tolist(),
            "error_in_given_norm": self.error_in_given_norm,
            "paper": {
                "assumptions": [a._asdict() for a in assumptions(self.scenario)],
                "theorem_2": None if self.theorem_2 is None else self.theorem_2._asdict(),
            },
            "certificates": [{"under": under, **certificate.to_json()} for under, certificate in self],
            "outputs": [
                {"under": under, "plants": certificate.scope, **bound.to_json()}
                for under, certificate in self
                for bound in self.output_bounds(certificate)
            ],
            "unproven": [each._asdict() for each in self.unproven],
            "stability": None if self.stability is None else self.stability.to_json(),
            "schedule": {
                f"{name}_s": getattr(self.scheduled, f"{name}_s") for name in ("sampling", "delay", "hold")
            },
            "limits": {scope: limits._asdict() for scope, limits in self.limits_by_scope.items()},
            "largest_settings": [dict(tried.values) for tried in self.largest_settings],
        }

    @property
    def rest(self) -> dict[str, float]:
        """Where the plant rests under its constant loads, by states: those whose rest is not 0."""
        loop = loop_of(self.scenario)
        own = zip(loop.state_names, loop.rest[: loop.n - loop.loads].tolist(), strict=False)
        return {name: value for name, value in own if value}

    def output_bounds(self, certificate: ScenarioCertificate) -> list[OutputBound]:
        """Return the bounds of the scenario's outputs by one of its certificates."""
        return output_bounds(
            certificate, self.scenario.loop_outputs(), self.setpoint,
            follows=self.follows_reference, rest=loop_of(self.scenario).rest.tolist(),
        )  # fmt: skip

    def _covering(self, plants: str, conditions: str) -> ScenarioCertificate | None:
        fitting = (certificate for certificate in self._of(conditions) if certificate.scope == plants)
        return next(fitting, None)

    def _of(self, conditions: str) -> list[ScenarioCertificate]:
        return [certificate for under, certificate in self if under == conditions]

    def _rows(self) -> TextRows:
        heads = [f"{under}, {covered_plants(certificate)}" for under, certificate in self]
        certificates = [certificate for _, certificate in self]
        names = [output.name for output in self.scenario.loop_outputs()]
        rows = [[label, *values] for label, values, _ in constant_rows(certificates, None, 0.0, names)]
        return [[self.scenario.name, *heads], *rows]

    def __repr__(self) -> str:
        return as_text(self._rows())

    def _repr_html_(self) -> str:
        return as_html(self._rows())


def _theorem_2(scenario: Scenario, certificate: ScenarioCertificate) -> Theorem2 | None:
    trigger, constants = scenario.trigger, certificate.constants
    if not isinstance(trigger, DecayingSettings) or constants is None:
        return None
    if constants.rate_per_s != trigger.alpha_per_s:
        return None
    if trigger.floor or trigger.weight is not None or not scenario.coverage.is_undisturbed:
        return None
    return theorem_2(loop_of(scenario), trigger.beta, trigger.alpha_per_s, constants.delta)


def with_weight(
    resolved: Scenario,
    norm_name: str,
    late_periods: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Scenario, Matrix | None]:
    """Return the scenario with the requested weight, and W if noack chose it for its schedule.

    Raises:
        CallerError: the choice is unknown, or no weight can be chosen for this scenario.
    """
    weight: Matrix | None = None
    one_of("weight", norm_name, ("given", "identity", "chosen"))
    if norm_name == "given":
        return resolved, None
    trigger = resolved.trigger
    if not isinstance(trigger, DecayingSettings):
        raise CallerError(
            f'weight {norm_name}: only for the paper\'s trigger, "decaying"; '
            f'the policy of this scenario is "{trigger.policy}"'
        )
    if norm_name == "chosen":
        try:
            weight = choose_weight(
                loop_of(resolved),
                trigger.beta,
                trigger.alpha_per_s,
                nominal_conditions(resolved, late_periods),
                progress,
            )
        except NotDecayingError as error:
            raise CallerError(f"weight chosen: {error}") from None
        except np.linalg.LinAlgError as error:  # extremely stiff models
            raise CallerError(f"weight chosen: {one_line(error)}") from None
    rows = None if weight is None else tuple(tuple(row) for row in weight.tolist())
    return resolved.model_copy(update={"trigger": trigger.model_copy(update={"weight": rows})}), weight


def with_linear_plant(resolved: Scenario) -> Scenario:
    """Return the scenario with its model as the plant."""
    plant = resolved.plant.model_copy(update={"system": LinearSettings()})
    return resolved.model_copy(update={"plant": plant})


def certificates_of(
    scenario: Scenario,
    weight: str = "given",
    late_periods: int | None = None,
    progress: Callable[[float], None] = lambda share: None,
    *,
    of_model: bool = False,
) -> Certificates:
    """Certify a scenario under the paper's conditions and under its own schedule.

    Args:
        scenario: as loaded; it is resolved here.
        weight: ``given``, ``identity`` or ``chosen``.
        late_periods: allowed lateness in steps of the plant, 0 to 1000; by default the scenario's.
        progress: called with the completed share of the choice of a weight.
        of_model: if the plant is not linear, certify the model as the plant; ``nonlinear`` says so.

    Raises:
        CallerError: the choice is unknown, or no certificate covers this scenario.
    """
    original = resolve(scenario)
    if original.model.load_states:
        require_certifiable(original)  # whatever the plant's equations are
    linear = linear_plant(original)
    is_model = of_model and not original.coverage.is_linear and linear is None
    resolved = with_linear_plant(original) if is_model else linear or original
    late = resolved.certificate.late_periods
    if late_periods is not None:
        late = whole_number("late", late_periods, 0, MOST_LATE)
    weighted, W = with_weight(resolved, weight, late, progress)
    rows = getattr(resolved.trigger, "weight", None)
    given = None if rows is None else np.array(rows)
    as_given = weighted.model_copy(update={"plant": original.plant})
    nonlinear, equations = (as_given if is_kind else None for is_kind in (is_model, linear is not None))
    return Certificates(weighted, late, W, given, nonlinear, equations)


def answer_for(scenario: Scenario) -> CertificateAnswer:
    """Whether a scenario's own plant has a certificate for its schedule, also where none covers it."""
    try:
        return certificates_of(scenario, of_model=True).answer
    except CallerError as error:
        return CertificateAnswer(False, f"no certificate: {str(error).removesuffix(NOT_COVERED)}")


def in_chosen_norm(
    scenario: Scenario, certificates: Certificates, progress: Callable[[float], None] = lambda share: None
) -> Certificates | None:
    """Return the certificates in a norm that noack chooses, if there are any for the schedule.

    Args:
        scenario: as loaded.
        certificates: its certificates in the given norm, of which there are none for the schedule.
        progress: called with the completed share of the choice.
    """
    with contextlib.suppress(CallerError):  # no weight can be chosen for this scenario
        chosen = certificates_of(scenario, "chosen", certificates.late_periods, progress, of_model=True)
        return chosen if chosen.schedule.exists else None
    return None
