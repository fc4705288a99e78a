"""The sizes of a loop's signals, from its record.

* :class:`SignalStatistics`: states and errors, in one pass over the aligned run; with them the
  :class:`SampleFacts` that claims need before they are checked.
* :func:`disturbances` of u and of ẋ.
"""

from functools import lru_cache
from typing import NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.summary_model import DisturbancePart, EstimationPart
from cosim.record.align import AlignedPart, AlignedRun, Reals, bounded_parts, is_bounded
from cosim.record.run_events import reference_in_run
from cosim.record.run_record import RunRecord
from netem.core.row_operations import row_norms
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.estimation import steady_state
from noack.scenario.scenario import Scenario


def expected_rms(resolved: Scenario) -> float:
    """Return the steady-state RMS of ‖x̂ − x‖ from noise and disturbances, for an exact model."""
    return float(np.sqrt(np.trace(steady_state(resolved).covariance)))


class SizeStatistics:
    """Root mean square and maximum of finite norms, part by part."""

    def __init__(self) -> None:
        self._squares, self._count = 0.0, 0
        self.max: float | None = None

    def add(self, norms: Reals) -> None:
        """Add norms, (k,); those that are not finite are ignored."""
        norms = norms[np.isfinite(norms)]
        if len(norms):
            self._squares += float(np.square(norms).sum())
            self._count += len(norms)
            largest = float(norms.max())
            self.max = largest if self.max is None else max(self.max, largest)

    @property
    def rms(self) -> float | None:
        """Their root mean square; None without values."""
        return float(np.sqrt(self._squares / self._count)) if self._count else None


def _larger(before: float | None, values: Reals) -> float | None:
    """Return the largest of the values and of those before; NaN if one is NaN."""
    if not len(values):
        return before
    largest = values.max()
    return float(largest if before is None else np.maximum(before, largest))


class SampleFacts(NamedTuple):
    """What claims need to know about all samples of a run before they are checked."""

    shares_an_update: bool = False
    """Whether sensor and controller ever had the same update: before, nothing bounds ‖e_c‖."""
    gap_s: float | None = None
    """First time at which the controller's error is not known, although it was before."""
    largest_state: float = 0.0
    """Largest entry of x_s, and of x_c where it is known."""
    longest_update_ns: int = 0
    """Longest time between two updates of the controller, or to the end of the run."""


class SampleFactsReader:
    """Reads these facts, part by part of an aligned run."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._facts = SampleFacts()
        self._fresh_ns: int | None = None
        self._newest, self._last_ns = -1, 0

    def take(self, aligned: AlignedRun, bounded: NDArray[np.bool_] | None = None) -> None:
        """Add the next measurements; where ‖e_c‖ is ``bounded`` may be known."""
        if not len(aligned.t_ns):
            return
        bounded = is_bounded(self._scenario, aligned) if bounded is None else bounded
        facts, t_s = self._facts, aligned.t_ns * 1e-9
        started = np.logical_or.accumulate(bounded) | facts.shares_an_update
        gaps = np.flatnonzero(started & ~bounded)
        gap_s = float(t_s[gaps[0]]) if facts.gap_s is None and len(gaps) else facts.gap_s
        both = np.concatenate([aligned.x_s, aligned.x_c.compress(bounded, axis=0)])
        largest = float(np.abs(both[np.isfinite(both)]).max(initial=facts.largest_state))
        changes = aligned.t_ns[np.flatnonzero(np.diff(aligned.received, prepend=self._newest))]
        ends_ns = changes if self._fresh_ns is None else np.append(self._fresh_ns, changes)
        longest_ns = int(np.diff(ends_ns).max(initial=facts.longest_update_ns))
        self._fresh_ns = int(ends_ns[-1]) if len(ends_ns) else None
        self._newest, self._last_ns = int(aligned.received[-1]), int(aligned.t_ns[-1])
        self._facts = SampleFacts(bool(started[-1]), gap_s, largest, longest_ns)

    @property
    def facts(self) -> SampleFacts:
        """What is known after the last part."""
        if self._fresh_ns is None:
            return self._facts
        since_ns = self._last_ns - self._fresh_ns
        longest_ns = max(self._facts.longest_update_ns, since_ns)
        return self._facts._replace(longest_update_ns=longest_ns)


class SignalFields(TypedDict):
    """The fields of a loop's summary about its signals."""

    setpoint: list[float] | None
    initial_state_norm: float | None
    final_state_norm: float | None
    sup_state_norm: float | None
    sup_e_s_norm: float | None
    sup_e_c_norm: float | None
    sup_e_c_at_s: float | None
    identity_residual_max: float | None
    identity_residual_relative: float | None


class SignalStatistics:
    """Reads the signals of a run once, aligned."""

    def __init__(self, record: RunRecord) -> None:
        self._record = record
        self._sup_e_s: float | None = None
        self._sup_e_c: float | None = None
        self._sup_e_c_at_s: float | None = None
        self._residual: float | None = None
        self._sup_true_e_c: float | None = None
        self._errors, self._late_errors = SizeStatistics(), SizeStatistics()
        self._scale, self._read = 0.0, 0
        self._half = record.count(SENSOR_MEASUREMENT) // 2
        facts = SampleFactsReader(record.scenario)
        for bounded in bounded_parts(record):
            part, residual = bounded.part, bounded.residual
            self._add(part)
            facts.take(part.aligned, bounded.is_bounded)
            self._residual = _larger(self._residual, residual[~np.isnan(residual)])
            self._estimation_error(part)
            self._read += len(part.rows)
        self.facts = facts.facts
        """What claims need to know before they are checked."""

    def _add(self, part: AlignedPart) -> None:
        aligned = part.aligned
        delivered = aligned.since_delivery(self._record.scenario)
        t_s, e_c = aligned.t_ns[delivered] * 1e-9, aligned.e_c_norm[delivered]
        self._sup_e_s = _larger(self._sup_e_s, aligned.e_s_norm)
        if len(e_c) and (self._sup_e_c is None or e_c.max() > self._sup_e_c):
            self._sup_e_c, self._sup_e_c_at_s = float(e_c.max()), float(t_s[np.argmax(e_c)])
        self._scale = float(np.maximum(self._scale, np.abs(aligned.x_s).max(initial=0.0)))

    def _estimation_error(self, part: AlignedPart) -> None:
        if part.true_x is None:
            return
        # ‖x_c − x‖_W with the plant's own x, from the controller's first update on
        aligned, weight = part.aligned, self._record.loop.weight
        e_c = aligned.x_c - part.true_x
        norms = row_norms(e_c if weight is None else e_c @ weight.T)
        counted = np.isfinite(norms) & aligned.since_delivery(self._record.scenario)
        self._sup_true_e_c = _larger(self._sup_true_e_c, norms[counted])
        errors = row_norms(part.rows["x"] - part.true_x)
        self._errors.add(errors)
        self._late_errors.add(errors[max(self._half - self._read, 0) :])

    def for_summary(self) -> SignalFields:
        """Return norms of the state, of the errors, and of the residual of (I1)."""
        first, last, largest = None, None, None
        reference = reference_in_run(self._record)
        states = self._record.scenario.model.plant_states
        for steps in self._record.batches(PLANT_STEP, ("t_ns", "x")):
            x = steps["x"]
            if reference is not None:
                x = x - reference.states(steps["t_ns"])
            norms = row_norms(x[:, :states])
            first = float(norms[0]) if first is None else first
            last, largest = float(norms[-1]), _larger(largest, norms)
        horizon_ns = self._record.scenario.timing.horizon_ns
        scale = max(self._scale, float(np.finfo(float).tiny))
        return {
            "setpoint": None if reference is None else reference.state(horizon_ns).tolist(),
            "initial_state_norm": first,
            "final_state_norm": last,
            "sup_state_norm": largest,
            "sup_e_s_norm": self._sup_e_s,
            "sup_e_c_norm": self._sup_e_c,
            "sup_e_c_at_s": self._sup_e_c_at_s,
            "identity_residual_max": self._residual,
            "identity_residual_relative": None if self._residual is None else self._residual / scale,
        }

    def estimation(self) -> EstimationPart | None:
        """Return the estimation error; None if the sensor measures x itself."""
        scenario = self._record.scenario
        if scenario.coverage.knows_state:
            return None
        return EstimationPart(
            observer=None if scenario.observer is None else scenario.observer.kind,
            outputs=scenario.message_sizes.outputs,
            noise_std=np.sqrt(scenario.plant.measurement.variance(self._record.loop.n)).tolist(),
            rms=self._errors.rms,
            rms_second_half=self._late_errors.rms,
            expected_rms=expected_rms(scenario),
            max=self._errors.max,
            sup_e_c_norm=self._sup_true_e_c,
        )


@lru_cache(maxsize=1)
@np.errstate(all="ignore")  # a run may diverge
def signal_statistics(record: RunRecord) -> "SignalStatistics":
    """Read the signals of a run; the summary and the claims use the same ones."""
    return SignalStatistics(record)


def disturbances(record: RunRecord) -> list[DisturbancePart]:
    """The disturbances of u and of ẋ."""
    parts = []
    for entry, column in (("input", "d"), ("state", "w")):
        if column not in (record.tables[PLANT_STEP].names or ()):
            continue
        sizes = SizeStatistics()
        for steps in record.batches(PLANT_STEP, (column,)):
            sizes.add(row_norms(steps[column]))
        kinds = [cause.kind for cause in record.scenario.plant.disturbances if cause.at == entry]
        parts.append(DisturbancePart(at=entry, kinds=kinds, rms=sizes.rms, max=sizes.max))
    return parts
