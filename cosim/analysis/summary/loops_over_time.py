"""The loops of a run over time: errors, states and shares of the link, in intervals of the run."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.quantiles import quantiles_in
from cosim.record.align import Reals, aligned_parts
from cosim.record.run_record import RecordedRun, Rows, RunRecord
from netem.core.packet_rows import NETEM_PACKET
from netem.core.row_operations import firsts_of_equal, row_norms

INTERVALS = 200
"""Intervals of equal width into which a run is divided."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Quantiles over the loops that are shown if there are too many loops for a curve each."""
_SHARED_INTERVALS = 8
"""Intervals over which the shares of the loops are computed: in one interval, few loops send."""


class LoopOverTime(NamedTuple):
    """Two quantities of one loop, (intervals,) each; see :class:`LoopsOverTime`."""

    errors: Reals
    states: Reals


class LoopsOverTime(NamedTuple):
    """Quantities of L loops in ``INTERVALS`` intervals of the run, each of shape (L, intervals)."""

    edges_s: Reals
    """(intervals + 1,) where the intervals begin and end, in the time of the run."""
    errors: Reals
    """Largest ‖e_c‖ since the first delivery; NaN where unknown."""
    states: Reals
    """Largest ‖x‖ at the plant's steps; NaN where unknown."""
    link_bytes: Reals
    """Bytes of the loop's updates that left the network."""

    @property
    def middles_s(self) -> Reals:
        """(intervals,) the middle of each interval."""
        return np.asarray((self.edges_s[1:] + self.edges_s[:-1]) / 2)

    def shares(self) -> tuple[Reals, Reals]:
        """Return longer intervals' ends in s, (k,), and the share of each loop, (L, k)."""
        loops = len(self.link_bytes)
        sums = self.link_bytes.reshape(loops, -1, _SHARED_INTERVALS).sum(axis=2)
        ends_s = self.edges_s[_SHARED_INTERVALS::_SHARED_INTERVALS]
        return ends_s, sums / np.where(sums.sum(axis=0) > 0, sums.sum(axis=0), np.nan)


def loops_over_time(run: RecordedRun, over_time: Sequence[LoopOverTime] | None = None) -> LoopsOverTime:
    """Return how the loops of a run went, from ``over_time`` of each, or from their records."""
    if over_time is None:
        over_time = [
            loop_over_time(record, phase_ns)
            for record, phase_ns in zip(run.loops, run.phases_ns, strict=True)
        ]
    together = empty_over_time(len(run.names), run.scenario.horizon_s)
    for number, (errors, states) in enumerate(over_time):
        together.errors[number], together.states[number] = errors, states
    add_link_bytes(together.link_bytes, run.network[NETEM_PACKET], run.scenario.timing.horizon_ns)
    return together


@np.errstate(all="ignore")  # a loop may diverge
def loop_over_time(record: RunRecord, phase_ns: int) -> LoopOverTime:
    """Return how a loop went that began at ``phase_ns`` in the time of its run."""
    horizon_ns = record.scenario.timing.horizon_ns
    errors, states = np.full((2, INTERVALS), np.nan)
    for part in aligned_parts(record):
        aligned = part.aligned
        columns = intervals_of(aligned.t_ns + phase_ns, horizon_ns)
        delivered = aligned.since_delivery(record.scenario)
        steps = intervals_of(part.plant.t_ns + phase_ns, horizon_ns)
        _update_largest(states, steps, row_norms(part.plant.x[:, : record.scenario.model.plant_states]))
        _update_largest(errors, columns[delivered], aligned.e_c_norm[delivered])
    return LoopOverTime(errors, states)


def _update_largest(largest: Reals, columns: NDArray[np.int64], values: Reals) -> None:
    """Raise the ``largest`` value of each interval to the values in it; ``columns`` ascends."""
    if len(columns):
        first = firsts_of_equal(columns)
        at = columns[first]
        largest[at] = np.fmax(largest[at], np.fmax.reduceat(values, first))


def empty_over_time(loops: int, horizon_s: float) -> LoopsOverTime:
    """Return the quantities of a run of some loops, of which nothing is known yet."""
    errors, states = np.full((2, loops, INTERVALS), np.nan)
    edges_s = np.linspace(0, horizon_s, INTERVALS + 1)
    return LoopsOverTime(edges_s, errors, states, np.zeros((loops, INTERVALS)))


def add_link_bytes(link_bytes: Reals, packets: Rows, horizon_ns: int) -> None:
    """Add the bytes of the packets that left the network to their loops, (L, intervals)."""
    left = (packets["release_ns"] >= 0) & (packets["release_ns"] <= horizon_ns)
    left &= packets["flow"] < len(link_bytes)  # the others are of the other direction
    packets = packets[left]
    columns = intervals_of(packets["release_ns"], horizon_ns)
    np.add.at(link_bytes, (packets["flow"], columns), packets["size_bytes"])


def intervals_of(t_ns: NDArray[np.int64], horizon_ns: int) -> NDArray[np.int64]:
    """Return the interval of each time of the run."""
    return np.asarray(np.minimum(t_ns * INTERVALS // horizon_ns, INTERVALS - 1))


def quantiles(values: Reals) -> Reals:
    """Return the ``QUANTILES`` over the loops of values (L, k), (6, k); NaN where all are."""
    known = np.isfinite(values)
    shares, counts = np.full((len(QUANTILES), values.shape[1]), np.nan), known.sum(axis=0)
    observed = np.flatnonzero(counts)
    ordered = np.sort(np.where(known, values, np.inf), axis=0)
    shares[:, observed] = quantiles_in(ordered, counts[observed], np.array(QUANTILES)[:, None], observed)
    return shares
