"""All certificates of a scenario: as one object, as JSON, and as rows of a table."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

from cosim.analysis.certificate_rows import certificate_rows, covered_plants
from cosim.analysis.scenario_certificates import certificate_of
from cosim.analysis.settings_with_certificates import (
    TriedSettings,
    helpful_box,
    helpful_settings,
    largest_settings,
)
from cosim.analysis.threshold_suggestions import ThresholdTrials
from cosim.analysis.witnesses import Unproven, Witnesses, find_witnesses, with_lateness
from netem.core.errors import CallerError
from netem.core.number_checks import whole_number
from netem.core.number_format import TextRows, as_html, as_text
from noack.core.progress import Progress, no_progress
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import (
    BOX,
    allowed_conditions,
    ideal_conditions,
    jump_s,
    outside_box,
)
from noack.theory.certificates.output_bounds import OutputBound, output_bounds
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
_UNDER = {"ideal": IDEAL, "schedule": SCHEDULE}
"""Names of conditions, by those of statements."""


class CertificateAnswer(NamedTuple):
    """Whether a scenario's own plant has a certificate for the scenario's schedule."""

    is_certified: bool
    text: str
    """Which plants are certified, or why the scenario's own plant is not."""


class Certificates:
    """The certificates of a scenario's plant, and of all plants in its uncertainty box.

    A certificate has bounds that the checker has proven, ``proven``, or None with the reason in ``void``.
    It has ``conditions`` on network and schedule, which it assumes, and ``assumptions``, each with its
    verdict. It has ``inter_event_s``, the minimum inter-event time, and three bounds as functions of time
    in seconds: ``sensor_error``, ``controller_error`` and ``state``; ``formula("‖x‖", "x")`` is one in
    words. ``docs/derivations.md`` has the argument. After :meth:`prove` they are those of the search;
    until then, those that are known already or need none.

    Iteration yields each certificate with the conditions that it assumes: IDEAL or SCHEDULE.

    >>> import noack
    >>> certificate = noack.certify("double_integrator").schedule
    >>> certificate.state([0.0, 5.0]).shape  # a bound of ‖x(t)‖ for each time
    (2,)

    Args:
        scenario: the resolved scenario. Its bounds of x are about its set-point or reference, or where it
            rests under its loads.

    Raises:
        CallerError: its settings change.
    """

    scenario: Scenario
    """The resolved scenario."""
    setpoint: tuple[float, ...] | None
    """x_r; all bounds of x are those of x − x_r. None: 0."""
    unproven: Sequence[Unproven] = ()
    """Plants and conditions of which nothing is proven, with the reasons."""

    def __init__(self, scenario: Scenario) -> None:
        scenario.coverage.require_constant()
        self.scenario = scenario
        self.threshold_advice = dict[str, str]()
        """By output: what brings it within its allowed error, see :meth:`advise`."""
        self.setpoint = scenario.controller.setpoint
        self.follows_reference = scenario.controller.reference is not None
        """Whether x is the distance from a reference that changes over time."""
        self.jump_s = jump_s(scenario)
        """When the reference first jumps: the certificates hold until then. None: it does not."""
        self._conditions = {
            IDEAL: ideal_conditions(scenario),
            SCHEDULE: allowed_conditions(scenario),
        }
        self._found: list[tuple[str, ScenarioCertificate]] | None = None
        self.is_searched = False
        """Whether :meth:`prove` has searched, instead of taking what needs no search."""

    def prove(
        self,
        progress: Progress = no_progress,
        most_work: float = MOST_WORK,
        conditions: Sequence[str] = ("ideal", "schedule"),
        near: Sequence[Mapping[str, object]] = (),
        plants: Sequence[str] | None = None,
    ) -> Witnesses:
        """Search for the smallest bounds that the checker proves.

        Args:
            progress: called with the completed share.
            most_work: limit of each search, see :class:`noack.theory.witnesses.effort.Effort`; 0: what is
                known already, or needs no search.
            conditions: "ideal" for the paper's conditions, and "schedule" for the scenario's own.
            near: documents of similar scenarios; the search begins near them.
            plants: some of :func:`cosim.analysis.witnesses.plants_of`; by default all.
        """
        self.is_searched = most_work > 0
        found = find_witnesses(self.scenario, progress, most_work, conditions, near, plants)
        self._found, self.unproven = [], found.unproven
        for statement in found.statements:
            under = _UNDER[statement.conditions]
            certificate = certificate_of(self.scenario, statement, self._conditions[under])
            self._found.append((under, certificate))
        return found

    def advise(self, progress: Progress = no_progress) -> None:
        """Search for a smaller threshold for each output whose bound exceeds its allowed error."""
        certificate = self.guaranteed
        if certificate is None or not self.scenario.coverage.is_linear:
            return
        plants = "box" if certificate.scope == BOX else "own"
        for index, bound in enumerate(self.output_bounds(certificate)):
            if not bound.is_met:
                stated = ThresholdTrials(self.scenario, plants)
                self.threshold_advice[bound.output.name] = stated.advice(bound, index, progress)

    def __iter__(self) -> Iterator[tuple[str, ScenarioCertificate]]:
        if self._found is None:
            self.prove(most_work=0.0)
        return iter(self._found or ())

    @property
    def paper(self) -> ScenarioCertificate | None:
        """Under the paper's conditions: no sampling, no delay and no held input; None if not asked for."""
        return next((certificate for under, certificate in self if under == IDEAL), None)

    @property
    def schedule(self) -> ScenarioCertificate:
        """Of the scenario's own plant under its own schedule, with its permitted lateness."""
        return self._of(SCHEDULE)[0]

    @property
    def paper_box(self) -> ScenarioCertificate | None:
        """For every plant in the box, under the paper's conditions; None if there is no box."""
        return self._of_box(IDEAL)

    @property
    def schedule_box(self) -> ScenarioCertificate | None:
        """For every plant in the box, under the scenario's schedule; None if there is no box."""
        return self._of_box(SCHEDULE)

    @property
    def guaranteed(self) -> ScenarioCertificate | None:
        """The one with most to say: of all plants within the uncertainty, or of the own plant; None: none."""
        own, box = self.schedule, self.schedule_box
        if box is not None and box.has("x") and outside_box(self.scenario) is None:
            return box
        return own if own.has("x") else None

    @property
    def theorem_2(self) -> Theorem2 | None:
        """Theorem 2 by the paper's formula, with Δ of ``paper``; None if it cannot be evaluated."""
        return theorem_2_of(self.scenario, self.paper)

    @property
    def answer(self) -> CertificateAnswer:
        """Whether the scenario's own plant has a certificate for its schedule."""
        certified = [each.scope for each in self._of(SCHEDULE) if each.exists]
        if self.schedule.exists:
            return CertificateAnswer(True, f"certified: {' and '.join(certified)}")
        void = self.schedule.void
        return CertificateAnswer(False, f"no certificate{f': {void}' if void else ''}")

    @property
    def is_proven_stable(self) -> bool:
        """Whether ‖x‖ of the scenario's own plant is proven to have a bound under all losses allowed."""
        if self.answer.is_certified:
            return True
        return self.stability is not None and self.stability.verdict == "stable"

    @cached_property
    def largest_settings(self) -> list[TriedSettings]:
        """Settings with which the scenario's own plant has a certificate, at their largest, each alone.

        Each takes some tries without a search, of about a second.
        """
        return [*largest_settings(self.scenario)] if self.schedule.exists else []

    @cached_property
    def helpful_settings(self) -> list[TriedSettings]:
        """Settings, each of which alone gives the scenario's own plant its missing certificate."""
        return [] if self.schedule.exists else [*helpful_settings(self.scenario)]

    @cached_property
    def helpful_box(self) -> TriedSettings | None:
        """A smaller uncertainty box with its missing certificate, while the plant has one."""
        box = self.schedule_box
        if box is None or box.exists or not self.schedule.exists:
            return None
        return helpful_box(self.scenario)

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
        scheduled = self._conditions[SCHEDULE]
        return {
            "scenario": self.scenario.name,
            "setpoint": self.setpoint,
            "theorem_2": None if self.theorem_2 is None else self.theorem_2._asdict(),
            "certificates": [{"under": under, **certificate.to_json()} for under, certificate in self],
            "outputs": [
                {"under": under, "plants": certificate.scope, **bound.to_json()}
                for under, certificate in self
                for bound in self.output_bounds(certificate)
            ],
            "unproven": [each._asdict() for each in self.unproven],
            "stability": None if self.stability is None else self.stability.to_json(),
            "schedule": {
                f"{name}_s": getattr(scheduled, f"{name}_s") for name in ("sampling", "delay", "hold")
            },
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

    def stated_bounds(self, certificate: ScenarioCertificate) -> list[OutputBound]:
        """Return those of the outputs that the scenario states."""
        return self.output_bounds(certificate) if self.scenario.outputs else []

    def _of_box(self, conditions: str) -> ScenarioCertificate | None:
        return next((each for each in self._of(conditions) if each.scope == BOX), None)

    def _of(self, conditions: str) -> list[ScenarioCertificate]:
        return [certificate for under, certificate in self if under == conditions]

    def _rows(self) -> TextRows:
        heads = [f"{under}, {covered_plants(certificate)}" for under, certificate in self]
        outputs = [self.stated_bounds(certificate) for _, certificate in self]
        rows = certificate_rows([certificate for _, certificate in self], outputs, state_norm(self))
        return [[self.scenario.name, *heads], *([label, *values] for label, values in rows)]

    def __repr__(self) -> str:
        return as_text(self._rows())

    def _repr_html_(self) -> str:
        return as_html(self._rows())


def state_norm(results: Certificates) -> str:
    """Return what bounds of the state are about: ‖x‖, or the distance from a set-point or reference."""
    return "‖x − x_r‖" if any(results.setpoint or ()) or results.follows_reference else "‖x‖"


def theorem_2_of(scenario: Scenario, ideal: ScenarioCertificate | None) -> Theorem2 | None:
    """Return Theorem 2 of a resolved scenario with the Δ that is proven under the paper's conditions.

    None if it is not about this loop, or no Δ is proven.
    """
    trigger, loop = scenario.trigger, loop_of(scenario)
    if not isinstance(trigger, DecayingSettings) or trigger.floor or loop.weight is not None:
        return None
    if not (scenario.coverage.is_linear and scenario.coverage.is_undisturbed):
        return None
    proven = None if ideal is None else ideal.proven
    error = None if proven is None else proven.bounds.get("e_c")
    if proven is None or error is None or error.constant or proven.rate_per_s != trigger.alpha_per_s:
        return None
    return theorem_2(loop, trigger.beta, trigger.alpha_per_s, error.decaying / trigger.beta)


def certificates_of(scenario: Scenario, late_periods: int | None = None) -> Certificates:
    """Return the certificates of a scenario under the paper's conditions and under its own schedule.

    Args:
        scenario: as loaded; it is resolved here.
        late_periods: allowed lateness in steps of the plant, 0 to 1000; by default the scenario's.

    Raises:
        CallerError: a wrong lateness, or settings that change.
    """
    resolved = resolve(scenario)
    if late_periods is not None:
        resolved = with_lateness(resolved, whole_number("late", late_periods, 0, MOST_LATE))
    return Certificates(resolved)


def answer_for(scenario: Scenario) -> CertificateAnswer:
    """Return whether a scenario's own plant has a certificate for its schedule, without a search."""
    try:
        results = certificates_of(scenario)
        results.prove(most_work=0.0, conditions=("schedule",))
    except CallerError as error:
        return CertificateAnswer(False, f"no certificate: {error}")
    return results.answer
