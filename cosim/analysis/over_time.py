"""The loops of a run over time: the errors and states of each, and its share of the network."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary_model import Claim, LoopSummary
from cosim.record.align import aligned_parts
from cosim.record.run_record import RecordedRun, Rows
from noack.config.scenario import Scenario, phases_ns
from noack.core.errors import ExitStatus
from noack.core.linear_systems import row_norms
from noack.core.number_format import number as shown
from noack.protocol.record_tables import NETEM_PACKET

INTERVALS = 200
"""Intervals of equal width into which a run is divided."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Quantiles over the loops that are shown if there are too many loops for a curve each."""
_SHARED_INTERVALS = 8
"""Intervals over which the shares of the loops are computed: in one interval, few loops send."""

Reals = NDArray[np.float64]


class LoopsOverTime(NamedTuple):
    """Quantities of L loops in ``INTERVALS`` intervals of the run, each of shape (L, intervals)."""

    edges_s: Reals
    """(intervals + 1,) where the intervals begin and end, in the time of the run."""
    errors: Reals
    """Largest ‖e_c‖ since the first delivery; NaN where unknown."""
    states: Reals
    """Largest ‖x‖, measured or estimated by the sensor; NaN where unknown."""
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


def loops_over_time(run: RecordedRun) -> LoopsOverTime:
    """Return how the loops of a run went; their records are read one after the other."""
    horizon_ns, phases = run.scenario.timing.horizon_ns, phases_ns(run.scenario)
    found = empty_over_time(run.scenario)
    for number, (record, phase_ns) in enumerate(zip(run.loops, phases, strict=True)):
        with np.errstate(all="ignore"):  # a loop may diverge
            for part in aligned_parts(record):
                aligned = part.aligned
                place = places(aligned.t_ns + phase_ns, horizon_ns)
                np.fmax.at(found.states[number], place, row_norms(aligned.x))
                common = aligned.since_delivery(record.scenario)
                np.fmax.at(found.errors[number], place[common], aligned.e_c_norm[common])
    add_link_bytes(found.link_bytes, run.network[NETEM_PACKET], horizon_ns)
    return found


def empty_over_time(scenario: Scenario) -> LoopsOverTime:
    """Return the quantities of a run of which nothing is known yet."""
    loops = len(phases_ns(scenario))
    errors, states = np.full((2, loops, INTERVALS), np.nan)
    edges_s = np.linspace(0, scenario.horizon_s, INTERVALS + 1)
    return LoopsOverTime(edges_s, errors, states, np.zeros((loops, INTERVALS)))


def add_link_bytes(link_bytes: Reals, packets: Rows, horizon_ns: int) -> None:
    """Add the bytes of the packets that left the network to their loops, (L, intervals)."""
    left = (packets["release_ns"] >= 0) & (packets["release_ns"] <= horizon_ns)
    left &= packets["flow"] < len(link_bytes)  # the others are of the other direction
    packets = packets[left]
    place = places(packets["release_ns"], horizon_ns)
    np.add.at(link_bytes, (packets["flow"], place), packets["size_bytes"])


def places(t_ns: NDArray[np.int64], horizon_ns: int) -> NDArray[np.int64]:
    """Return the interval of each time of the run."""
    return np.asarray(np.minimum(t_ns * INTERVALS // horizon_ns, INTERVALS - 1))


def quantiles(values: Reals) -> Reals:
    """Return the ``QUANTILES`` over the loops of values (L, k), (6, k); NaN where all are."""
    known = np.where(np.isfinite(values), values, np.nan)
    found = np.full((len(QUANTILES), values.shape[1]), np.nan)
    seen = np.isfinite(known).any(axis=0)
    found[:, seen] = np.nanquantile(known[:, seen], QUANTILES, axis=0)
    return found


class WorstLoop(NamedTuple):
    """The loop that is shown in detail."""

    number: int
    why: str
    """What makes it the worst."""


def worst_loop(loops: Sequence[LoopSummary]) -> WorstLoop:
    """Return the worst loop of a run.

    That is a loop that failed; else the one that came nearest to, or exceeded, a certified bound of
    ‖e_c‖ or ‖x‖; without such bounds, the one with the largest ‖e_c‖.
    """
    for loop in loops:
        if loop.exit.status != ExitStatus.OK:
            return WorstLoop(loop.number, loop.exit.reason)
    used = [_share_used(loop.claims) for loop in loops]
    if max(used) > 0:
        place = int(np.argmax(used))
        text = f"largest share of a certified bound of ‖e_c‖ or ‖x‖: {100 * used[place]:.3g} %"
        return WorstLoop(loops[place].number, text)
    errors = [-1.0 if loop.sup_e_c_norm is None else loop.sup_e_c_norm for loop in loops]
    place = int(np.argmax(errors))
    text = f"largest ‖e_c‖, {shown(errors[place])}; no loop has a certified bound"
    return WorstLoop(loops[place].number, text)


def _share_used(claims: Sequence[Claim]) -> float:
    """Return the largest share of a certified bound that a loop reached; 0 without a bound."""
    return max(
        (
            claim.ratio
            for claim in claims
            if "certificate" in claim.source
            and claim.ratio is not None
            and claim.bound.startswith(("‖e_c‖ ≤", "‖x‖ ≤"))
        ),
        default=0.0,
    )
