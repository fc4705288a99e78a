"""What the model does not explain in a run, and what all checks use: exact flows and tolerances."""

from bisect import bisect_right
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.record.rows import Rows
from cosim.record.run_events import changes_of
from cosim.record.run_record import RunRecord
from netem.core.clock import NEVER_NS, NS_PER_S
from noack.core.linear_systems import Matrix, Vector
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario

ROUNDING = 1e-9
"""Largest relative difference that is taken as rounding."""
_LARGEST = 1e100
"""A run that diverges is explained up to the first larger number."""
SCHEDULE = "schedule"
"""The part of findings about times that a late process exceeds, in a live run."""


class Unexplained(NamedTuple):
    """Something in a record that no run of the model has."""

    t_s: float
    part: str
    """What it concerns, such as "plant"; `SCHEDULE` for lateness."""
    what: str

    def __str__(self) -> str:
        """The finding in one line."""
        return f"t = {self.t_s:.6f} s, {self.part}: {self.what}"


class ExplainedLoop:
    """The record of a loop up to the first change that the model depends on, or until it diverges.

    Args:
        record: the record of the loop.
    """

    def __init__(self, record: RunRecord) -> None:
        self.record, self.scenario = record, record.scenario
        self.loop = loop_of(record.scenario)
        changes = [change.first_ns for change in changes_of(record) if change.touches_claims]
        self.until_ns = min([*changes, _diverges_ns(record[PLANT_STEP])])
        self.findings: list[Unexplained] = []
        self._flows: dict[int, Matrix] = {}
        self._resting: dict[int, Vector | None] = {}

    def rows(self, table: str, *, time: str = "t_ns") -> Rows:
        """Return the rows of a table before the first change, in the order of inputs."""
        rows = self.record[table]
        return rows[rows[time] < self.until_ns]

    def add(self, t_ns: float, part: str, what: str) -> None:
        """Add a finding."""
        self.findings.append(Unexplained(t_ns / NS_PER_S, part, what))

    def flow(self, x: Vector, from_ns: int, to_ns: int) -> Vector:
        """Return where the models bring a state x from a time to another: about the reference, by e^{Hτ}."""
        jumps_ns = [] if self.loop.reference is None else self.loop.reference.since_ns
        for end_ns in [*(t_ns for t_ns in jumps_ns if from_ns < t_ns < to_ns), to_ns]:
            dt_ns, n = end_ns - from_ns, len(x)
            if not dt_ns:
                continue
            if dt_ns not in self._flows:
                self._flows[dt_ns] = exponential(self.loop.H * (dt_ns * 1e-9))
            about, then = self.point(from_ns)[:n], self.point(end_ns, since_ns=from_ns)[:n]
            x, from_ns = np.asarray(then + self._flows[dt_ns] @ (x - about)), end_ns
        return x

    def point(self, t_ns: int, *, since_ns: int | None = None) -> Vector:
        """Return x_r and u_r at a time, (n + m,), by the segment of that time, or of an earlier one."""
        reference = self.loop.reference
        if reference is None:
            return np.zeros(self.loop.n + self.loop.m)
        place = bisect_right(reference.since_ns, t_ns if since_ns is None else since_ns)
        segment = reference.segments[place]
        if place not in self._resting:
            self._resting[place] = segment.at(0.0) if segment.is_constant else None
        resting = self._resting[place]
        return segment.at((t_ns - segment.begin_ns) * 1e-9) if resting is None else resting

    def is_near(self, found: Vector, expected: Vector, *scales: Vector) -> bool:
        """Whether two vectors differ by no more than rounding errors of numbers as large as the scales."""
        entries = chain.from_iterable(v.tolist() for v in (found, expected, *scales))  # few: numpy is slower
        limit = ROUNDING * max(map(abs, entries), default=0.0) + 1e-300
        return all(map(limit.__ge__, map(abs, (found - expected).tolist())))


def _diverges_ns(steps: Rows) -> int:
    """Return the time of the plant's first extreme state."""
    extreme = ~(np.abs(steps["x"]) < _LARGEST).all(axis=1)
    return int(steps["t_ns"][np.argmax(extreme)]) if extreme.any() else NEVER_NS


def exponential(M: Matrix) -> Matrix:
    """Return e^M by scipy, which is independent of the core's."""
    from scipy.linalg import expm

    return np.asarray(expm(M))


def is_moderate(*vectors: NDArray[np.float64]) -> bool:
    """Whether all entries are finite, and not as large as those of a diverging run."""
    return all(bool((np.abs(v) < _LARGEST).all()) for v in vectors)


def bound_at(scenario: Scenario, place: str, entries: int) -> Vector:
    """Return the largest sizes of the disturbances at a place, (entries,); infinite if they have none."""
    bound = np.zeros(entries)
    for disturbance in scenario.plant.disturbances:
        if disturbance.at == place:
            bound += np.abs(disturbance.extent()).sum(axis=1)
            bound[np.abs(disturbance.deviations()).sum(axis=1) > 0] = np.inf
    return bound
