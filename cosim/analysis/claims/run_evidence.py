"""The data that claims are checked against: signals, observed conditions, certificates."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.certificates import theorem_2_of
from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.claims.observed_conditions import ObservedConditions, Reals
from cosim.analysis.claims.run_certificates import RunCertificate, certificates_under, scheduled_certificates
from cosim.analysis.claims.trajectory_delta import trajectory_delta
from cosim.analysis.conformance.common_end import common_end_ns, up_to_common_end
from cosim.analysis.conformance.input_origins import PlantInputs, plant_inputs
from cosim.analysis.conformance.recorded_loop import MOST_STEPS, RecordedLoop
from cosim.analysis.conformance.run_conformance import conformance_of_loop, reference_of_bounds
from cosim.analysis.conformance.run_document import RunDocument
from cosim.analysis.conformance.verdicts import Conformance
from cosim.analysis.scenario_certificates import quick_certificate
from cosim.analysis.summary.signal_statistics import SampleFacts, signal_statistics
from cosim.analysis.summary.summary_model import ClaimCause
from cosim.record.align import AlignedRun, PlantStates, aligned_parts, bounded_parts
from cosim.record.run_events import changes_of
from cosim.record.run_record import RunRecord
from netem.core.clock import NEVER_NS
from netem.core.errors import CallerError
from netem.core.row_operations import all_entries
from noack.protocol.record_tables import NO_SEQUENCE
from noack.protocol.roles import LOOP_ROLES
from noack.scenario.runtime_parameters import SETPOINT
from noack.theory.certificates.conditions import (
    BOX,
    NetworkConditions,
    allowed_conditions,
    nominal_conditions,
    outside_box,
)
from noack.theory.coverage import is_linear_loop
from noack.theory.paper import Theorem2

ROUNDING = 1e-9
"""Relative rounding error of an exact computation over a run of 10,000 steps."""
_LONG_S = 1e300  # finite: the delay of an input that never arrived is infinite


class ClaimEnd(NamedTuple):
    """The time from which nothing is claimed, and why."""

    t_s: float
    cause: ClaimCause
    detail: str = ""
    """The process, the rule or the reason that the cause is about."""


def earliest(candidates: Iterable[ClaimEnd | None]) -> ClaimEnd | None:
    """The first of several; None if there is none."""
    return min(filter(None, candidates), default=None)


@dataclass(frozen=True)
class Samples:
    """Consecutive measurements of a run, (k,), aligned, with bounds of the controller's error.

    And the plant's steps up to the last of them, (j,): claims about x hold at each.
    """

    aligned: AlignedRun
    is_bounded: NDArray[np.bool_]
    """Where sensor and controller share an update, so that ‖e_c‖ is bounded, (k,)."""
    error_bounds: Sequence[Reals]
    """Bounds of ‖e_c‖_W from (I1) and from eq:LossEv3, (k,) each; NaN before the start."""
    residual: Reals
    """Residual of (I1), (k,)."""
    true_x: Reals
    """x of the plant at the measurements, (k, n), where the sensor estimates it, too; NaN where it is
    not recorded."""
    plant: PlantStates
    """x of the plant at each of its steps, (j, n)."""
    inter_event_s: tuple[Reals, Reals]
    """Times of the events, without the run's first, and the times since the event before."""

    @cached_property
    def t_s(self) -> Reals:
        """Times of the measurements, (k,)."""
        return np.asarray(self.aligned.t_ns * 1e-9)

    @cached_property
    def step_s(self) -> Reals:
        """Times of the plant's steps, (j,)."""
        return np.asarray(self.plant.t_ns * 1e-9)

    @cached_property
    def with_x(self) -> NDArray[np.bool_]:
        """At which measurements the plant's own state is known, (k,)."""
        if self.true_x is self.aligned.x:
            return np.ones(len(self.true_x), dtype=bool)
        return np.asarray(all_entries(np.isfinite(self.true_x)))


@dataclass(eq=False)
class RunEvidence:
    """The data of a run for checking claims; each property is computed once, when first used."""

    record: RunRecord
    """That of the run; for certificates of a run with a reference, in deviations from it; of a stopped
    run, up to its common end."""
    whole_record: RunRecord | None = None
    """That of the whole run, if it is another one."""
    until_s: float = math.inf
    """End of what certificates claim: the first change of a setting on which they depend."""
    scheduled: Sequence[RunCertificate] | None = None
    """The certificates under the scenario's schedule, if they are known."""
    offset: float = 0.0
    """‖x_r‖ of the set-point: x in deviations has the rounding errors of x."""
    is_moved: bool = False
    """Whether ``record`` is in deviations from a reference."""
    most_work: float = 0.0
    """Limit of the search for a witness; 0: only those are used that are known."""
    most_steps: int = MOST_STEPS
    """So many steps are compared with a loop document in all numbers."""

    def samples(self) -> Iterator[Samples]:
        """Yield all measurements in order, part by part."""
        last_ns = np.zeros(0, np.int64)
        for part, bounded, both, residual in bounded_parts(self.record):
            rows, aligned = part.rows, part.aligned
            event_ns = np.append(last_ns, rows["t_ns"][rows["event"] != NO_SEQUENCE])
            passed = event_ns[1:] * 1e-9, np.diff(event_ns) * 1e-9
            last_ns = event_ns[-1:]
            true_x = aligned.x if part.true_x is None else part.true_x
            yield Samples(aligned, bounded, both, residual, true_x, part.plant, passed)

    @cached_property
    def lost_in_rounding(self) -> ClaimEnd | None:
        """When the threshold falls below the rounding of x at a set-point: events are chance."""
        for part in aligned_parts(self.record) if self.offset else ():
            aligned = part.aligned
            compared = aligned.threshold > 0  # a periodic trigger compares nothing
            below = np.flatnonzero(compared & (aligned.threshold < self.rounding(aligned.x_norm)))
            if len(below):
                return ClaimEnd(float(aligned.t_ns[below[0]]) * 1e-9, ClaimCause.ROUNDING)
        return None

    def rounding(self, x_norm: Reals) -> Reals:
        """Return the rounding error of states, from their norms, (k,) each."""
        return np.asarray(ROUNDING * (x_norm + self.offset))

    @cached_property
    def facts(self) -> SampleFacts:
        """What must be known about all samples before the claims are checked."""
        return signal_statistics(self.record).facts

    @cached_property
    def trajectory_delta(self) -> float | None:
        """Theorem 1's Δ from the trajectory, up to the first violation of its assumptions."""
        end = self.paper_end
        until_s = self.until_s if end is None else min(self.until_s, end.t_s)
        return trajectory_delta(self.record, until_s)

    @cached_property
    def _scheduled(self) -> Sequence[RunCertificate]:
        """The certificates under the scenario's schedule."""
        if self.scheduled is not None:
            return self.scheduled
        return scheduled_certificates((self.whole_record or self.record).scenario, self.most_work)

    @cached_property
    def late(self) -> Sequence[RunCertificate] | None:
        """The certificates for the times that occurred, of a run that was later than allowed.

        Their documents say so. None: the run was not late, rows that are missing may be later, or there is no
        such certificate.
        """
        whole_record, widest = (
            self.whole_record or self.record,
            self.observed.widen(self.allowed, self.until_s),
        )
        if widest == self.allowed or not all(map(whole_record.is_complete, LOOP_ROLES)):
            return None
        if not any(each.certificate.exists for each in self._scheduled):
            return None
        certificates = certificates_under(widest, whole_record.scenario, self.most_work)
        return certificates if any(each.certificate.exists for each in certificates) else None

    @cached_property
    def certificates(self) -> list[RunCertificate]:
        """The certificates of the run: those of its scenario, or of its lateness, where there are some."""
        pairs = zip(self._scheduled, self.late or self._scheduled, strict=True)
        return [late if late.certificate.exists else scheduled for scheduled, late in pairs]

    @property
    def certified_for(self) -> NetworkConditions | None:
        """The conditions of the certificates of the run's lateness, if one of them is used."""
        used = [each.certificate for each in self.certificates if each.certificate.exists]
        late = [each.certificate for each in self.late or ()]
        return next((each.conditions for each in late if any(each is one for one in used)), None)

    @cached_property
    def _conformances(self) -> Mapping[int, Conformance | CallerError]:
        """Whether the run is one of the certificates' loop documents, by the ``id`` of the document.

        What is read of the record is needed no longer than this takes.
        """
        documents = [each.document for each in self.certificates if each.document is not None]
        if not documents:
            return {}
        found: dict[int, Conformance | CallerError] = {}
        whole_record = self.whole_record or self.record
        record, reference = up_to_common_end(whole_record), reference_of_bounds(whole_record.scenario)
        try:
            recorded = RecordedLoop(record, self._inputs, self.until_s, self.most_steps)
        except CallerError as error:
            return {id(document): error for document in documents}
        for document in documents:
            try:
                found[id(document)] = conformance_of_loop(recorded, document, reference)
            except CallerError as error:
                found[id(document)] = error
        return found

    def conformance_of(self, document: RunDocument) -> Conformance:
        """Return whether the run is one of a certificate's loop document, up to the end of what it claims.

        Raises:
            CallerError: the record cannot be compared with it.
        """
        found = self._conformances[id(document)]
        if isinstance(found, CallerError):
            raise found
        return found

    def end_of(self, certificate: RunCertificate) -> ClaimEnd | None:
        """Return from when on the bounds of a certificate need not hold; None: they hold of the whole run."""
        if certificate.document is None:
            return ClaimEnd(0.0, ClaimCause.NO_DOCUMENT, certificate.missing)
        if certificate.certificate.scope == BOX and (why := outside_box(self.record.scenario)) is not None:
            return ClaimEnd(0.0, ClaimCause.OUTSIDE, why)
        try:
            failure = self.conformance_of(certificate.document).failure
        except CallerError as error:
            return ClaimEnd(0.0, ClaimCause.NO_DOCUMENT, str(error))
        not_one = None if failure is None else ClaimEnd(failure.t_s, ClaimCause.CONFORMANCE)
        return earliest([not_one, self.first_gap])

    @cached_property
    def _inputs(self) -> PlantInputs | None:
        """The inputs of the plant; None if they are in deviations."""
        return None if self.is_moved else plant_inputs(self.record)

    @cached_property
    def observed(self) -> ObservedConditions:
        """The conditions under which the run took place."""
        conditions = read_conditions(self.record, self._inputs)
        if self.whole_record is None or not self.offset:
            return conditions
        return conditions._replace(safe_input=read_conditions(self.whole_record).safe_input)  # in deviations

    @cached_property
    def largest_observed(self) -> dict[str, float | None]:
        """Largest observed value of each condition."""
        return self.observed.summary()

    @property
    def started_s(self) -> float:
        """When the plant applied the first input of the controller; infinite if never."""
        return self.observed.start_s

    def bounds_controller_error(self, t_s: Reals) -> NDArray[np.bool_]:
        """Return where the certificates bound e_c, (k,).

        The plant applies the controller's input, and x_c has every update with which it was computed, and
        no other one.
        """
        is_bounded = t_s >= self.started_s - 1e-9
        acts_s, reset_s = map(np.sort, self.observed.early)
        is_bounded &= np.searchsorted(acts_s, t_s, "right") <= np.searchsorted(reset_s, t_s, "right")
        reset_s, acts_s = map(np.sort, self.observed.waiting)
        is_bounded &= np.searchsorted(reset_s, t_s, "right") <= np.searchsorted(acts_s, t_s, "right")
        return np.asarray(is_bounded)

    @cached_property
    def first_gap(self) -> ClaimEnd | None:
        """The time from which no claim can be checked.

        The record is incomplete, or the error of a process's clock is not bounded as required.
        """
        observed = self.observed
        gaps: list[ClaimEnd] = []
        if (missing := observed.sampling.excess(self._nominal.sampling_s)) is not None:
            gaps.append(ClaimEnd(missing.first_s, ClaimCause.MISSING_MEASUREMENT))
        for role, early in observed.early_messages.items():
            if (excess := early.excess(observed.allowed_leads_s[role])) is not None:
                gaps.append(ClaimEnd(excess.first_s, ClaimCause.CLOCK, role))
        whole_record = self.whole_record or self.record
        end_ns = common_end_ns(whole_record)
        end_s = math.inf if end_ns is None else end_ns * 1e-9
        for role in LOOP_ROLES:
            gap_ns = None if whole_record.is_complete(role) else whole_record.rows_of(role).gap_ns
            if gap_ns is not None and 0 <= (at_s := gap_ns * 1e-9) <= end_s:
                gaps.append(ClaimEnd(at_s, ClaimCause.MISSING_ROWS, role))
        if (gap_s := self.facts.gap_s) is not None:
            gaps.append(ClaimEnd(gap_s, ClaimCause.NO_ERROR))
        return earliest(gaps)

    @cached_property
    def models_apart(self) -> ClaimEnd | None:
        """When sensor and controller first had different set-points: then (I1) does not hold."""
        for change in changes_of(self.record):
            times_ns = {change.since_ns.get(role, NEVER_NS) for role in ("sensor", "controller")}
            if SETPOINT in change.change.settings and len(times_ns) > 1:
                return ClaimEnd(min(times_ns) * 1e-9, ClaimCause.SETPOINTS)
        return None

    @cached_property
    def paper_end(self) -> ClaimEnd | None:
        """When the guarantee or u = K x_c, which the paper's theorems assume, first did not hold."""
        observed, ends = self.observed, [self.first_gap]
        if (broken := observed.first_broken_rule(self._nominal._replace(delay_s=_LONG_S))) is not None:
            ends.append(ClaimEnd(broken[0], ClaimCause.LOSSES, broken[1]))
        for series, cause in (
            (observed.watchdog, ClaimCause.WATCHDOG),
            (observed.safe_input, ClaimCause.SAFE_INPUT),
        ):
            if len(series.t_s):
                ends.append(ClaimEnd(float(series.t_s[0]), cause))
        return earliest(ends)

    @cached_property
    def allowed(self) -> NetworkConditions:
        """The conditions of the scenario's certificates."""
        return allowed_conditions(self.record.scenario)

    @cached_property
    def _nominal(self) -> NetworkConditions:
        return nominal_conditions(self.record.scenario)

    @cached_property
    def theorem_2(self) -> Theorem2 | None:
        """Theorem 2 with a proven Δ under the paper's conditions; None if there is none."""
        scenario = self.record.scenario
        if not is_linear_loop(scenario):
            return None
        return theorem_2_of(scenario, quick_certificate(scenario, ideal=True))
