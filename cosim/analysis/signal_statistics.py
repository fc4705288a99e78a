"""Sizes of a run's signals: states, errors, disturbances, part by part of the record."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary_model import DisturbancePart, EstimationPart, WatchdogPart
from cosim.record.align import (
    AlignedPart,
    AlignedRun,
    IdentityResidual,
    aligned_parts,
    in_common,
)
from cosim.record.estimation_error import Reals, SizeStatistics, expected_rms
from cosim.record.record_source import joined, with_columns
from cosim.record.run_record import RunRecord
from noack.config.scenario import Scenario
from noack.core.linear_systems import row_norms
from noack.protocol.record_tables import (
    NO_SEQUENCE,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from plant_server.plant import too_old


def _larger(before: float | None, values: Reals) -> float | None:
    """Return the largest of the values and of those before; NaN if one is NaN."""
    if not len(values):
        return before
    largest = values.max()
    return float(largest if before is None else np.maximum(before, largest))


class SampleFacts(NamedTuple):
    """What claims need to know about all samples of a run before they are checked."""

    any_in_common: bool = False
    gap_s: float | None = None
    """First time at which the controller's error is not known, although it was before."""
    largest_state: float = 0.0
    """Largest entry of x_s, and of x_c where it is known, before the end of the claims."""
    longest_update_ns: int = 0
    """Longest time between two updates of the controller, or to the end of the run."""


class SampleFactsReader:
    """Reads these facts, part by part of an aligned run; the claims end at ``until_s``."""

    def __init__(self, scenario: Scenario, until_s: float = math.inf) -> None:
        self._scenario, self._until_s = scenario, until_s
        self._found = SampleFacts()
        self._fresh_ns: int | None = None
        self._newest, self._last_ns = -1, 0

    def take(self, joined: AlignedRun) -> None:
        """Add the next measurements."""
        if not len(joined.t_ns):
            return
        found, common, t_s = self._found, shares_update(self._scenario, joined), joined.t_ns * 1e-9
        started = np.logical_or.accumulate(common) | found.any_in_common
        gaps = np.flatnonzero(started & ~common)
        gap_s = float(t_s[gaps[0]]) if found.gap_s is None and len(gaps) else found.gap_s
        until = t_s < self._until_s
        both = np.concatenate([joined.x_s[until], joined.x_c[common & until]])
        largest = float(np.abs(both[np.isfinite(both)]).max(initial=found.largest_state))
        changes = joined.t_ns[np.flatnonzero(np.diff(joined.received, prepend=self._newest))]
        ends_ns = changes if self._fresh_ns is None else np.append(self._fresh_ns, changes)
        longest_ns = int(np.diff(ends_ns).max(initial=found.longest_update_ns))
        self._fresh_ns = int(ends_ns[-1]) if len(ends_ns) else None
        self._newest, self._last_ns = int(joined.received[-1]), int(joined.t_ns[-1])
        self._found = SampleFacts(bool(started[-1]), gap_s, largest, longest_ns)

    @property
    def facts(self) -> SampleFacts:
        """What is known after the last part."""
        if self._fresh_ns is None:
            return self._found
        since_ns = self._last_ns - self._fresh_ns
        longest_ns = max(self._found.longest_update_ns, since_ns)
        return self._found._replace(longest_update_ns=longest_ns)


def shares_update(scenario: Scenario, joined: AlignedRun) -> NDArray[np.bool_]:
    """Return where sensor and controller share an update, and ‖e_c‖ is finite, (k,)."""
    finite = np.isfinite(joined.e_c_norm) & np.isfinite(joined.x_s).all(axis=1)
    return np.asarray(finite & in_common(scenario, joined))


@lru_cache(maxsize=1)
@np.errstate(all="ignore")  # a run may diverge
def signal_statistics(record: RunRecord) -> "SignalStatistics":
    """Read the signals of a run; the summary and the claims use the same ones."""
    return SignalStatistics(record)


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
        residual = IdentityResidual(record.scenario)
        for part in aligned_parts(record):
            self._add(part)
            facts.take(part.aligned)
            left = residual.take(part)
            self._residual = _larger(self._residual, left[~np.isnan(left)])
            self._estimation_error(part)
            self._read += len(part.rows)
        self.facts = facts.facts
        """What claims need to know before they are checked."""

    def _add(self, part: AlignedPart) -> None:
        aligned = part.aligned
        common = aligned.since_delivery(self._record.scenario)
        t_s, e_c = aligned.t_ns[common] * 1e-9, aligned.e_c_norm[common]
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

    def for_summary(self) -> dict[str, Any]:
        """Return norms of the state, of the errors, and of the residual of (I1)."""
        first, last = None, None
        for steps in self._record.source.batches(PLANT_STEP, ("x",)):
            first = float(row_norms(steps["x"][:1])[0]) if first is None else first
            last = float(row_norms(steps["x"][-1:])[0])
        scale = max(self._scale, float(np.finfo(float).tiny))
        return {
            "initial_state_norm": first,
            "final_state_norm": last,
            "sup_e_s_norm": self._sup_e_s,
            "sup_e_c_norm": self._sup_e_c,
            "sup_e_c_at_s": self._sup_e_c_at_s,
            "identity_residual_max": self._residual,
            "identity_residual_relative": None
            if self._residual is None
            else self._residual / scale,
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


def disturbances(record: RunRecord) -> list[DisturbancePart]:
    """The disturbances of u and of ẋ."""
    found = []
    for place, column in (("input", "d"), ("state", "w")):
        if column not in (record.tables[PLANT_STEP].names or ()):
            continue
        sizes = SizeStatistics()
        for steps in record.source.batches(PLANT_STEP, (column,)):
            sizes.add(row_norms(steps[column]))
        kinds = [one.kind for one in record.scenario.plant.disturbances if one.at == place]
        found.append(DisturbancePart(at=place, kinds=kinds, rms=sizes.rms, max=sizes.max))
    return found


def watchdog_actions(record: RunRecord) -> WatchdogPart:
    """Return the watchdog's actions (the newest actuation was too old) from the recorded steps."""
    timing = record.scenario.timing
    names = ("now_ns", "sequence", "t_ns", "actuation")
    received = np.zeros(0, with_columns(record.tables[PLANT_ACTUATION], names))
    trips, steps_old, first_s, was_old = 0, 0, None, False
    for part in record.slices(PLANT_STEP, PLANT_ACTUATION, columns=names):
        steps = part[PLANT_STEP]
        received = joined([received, part[PLANT_ACTUATION]], received.dtype)
        found = np.searchsorted(received["sequence"], steps["actuation"])
        there = np.append(received["sequence"], NO_SEQUENCE)[found] == steps["actuation"]
        newest_ns = np.where(
            steps["actuation"] != NO_SEQUENCE, np.append(received["t_ns"], 0)[found], 0
        )
        # If an actuation is not recorded, its age is unknown.
        old = there & too_old(steps["t_ns"], newest_ns, timing.actuation_timeout_ns)
        begun = np.flatnonzero(old & ~np.append(was_old, old[:-1])[: len(old)])
        if len(begun) and first_s is None:
            first_s = float(steps["t_ns"][begun[0]]) * 1e-9
        trips, steps_old = trips + len(begun), steps_old + int(old.sum())
        if len(steps):  # a later step has the newest of these actuations, or a later one
            was_old, received = bool(old[-1]), received[int(found[-1]) :]
    return WatchdogPart(
        policy=record.scenario.plant.watchdog.policy,
        timeout_s=timing.actuation_timeout_ns * 1e-9,
        trips=trips,
        first_s=first_s,
        total_s=steps_old * timing.plant_period_ns * 1e-9,
    )
