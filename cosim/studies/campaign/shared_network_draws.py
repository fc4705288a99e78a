"""Runs of a campaign whose loops share a network, in virtual time.

Numbers of transmissions and deliveries are those of all loops; the cost is the mean over the loops.
Times, errors and loss bursts are those of the worst loop.

A loop has used up its guarantee where the shared queue brought it to the longest burst of losses
that the guarantee allows: M − 1 consecutive losses, at least one of them in a full queue. Its next
update enters the full queue. An update is late if it is in the network for longer than
``certificate.network_delay_s``, or one measurement period if that is not given.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.summary_model import ClaimVerdict
from cosim.record.run_record import Rows, RunRecord
from cosim.simulation.batch import ROW
from cosim.simulation.exact_simulation import OK
from cosim.simulation.virtual_time import simulate_loops
from cosim.studies.campaign.random_draws import seeds_of
from cosim.studies.campaign.sampled_draws import SampledWork
from noack.core.clock import NS_PER_S
from noack.protocol.record_tables import NETEM_PACKET, Fate, effective

LOOPS_ROW = np.dtype(
    [
        *ROW.descr,
        *(
            (name, "<f8")
            for name in (
                "cost_worst", "loops_failed", "loops_claims_held",
                "loops_guarantee_used", "updates_late", "delay_max_s",
            )
        ),
    ]
)  # fmt: skip
"""The row of a run of loops that share a network.

cost_worst: the largest cost of a loop. loops_failed: share of the loops that diverged or exceeded
the largest number of events. loops_claims_held: share of the loops of which every claim held.
loops_guarantee_used: share of the loops that used up the guarantee. updates_late: share of the
delivered updates that were late. delay_max_s: largest time of a delivered update in the network.
"""
_OF_ALL: Mapping[str, Callable[[NDArray[Any]], Any]] = {
    "transmissions": np.sum, "deliveries": np.sum, "longest_loss_burst": np.max,
    "inter_event_min_s": np.min, "inter_event_mean_s": np.mean, "settling_s": np.max,
    "cost": np.mean, "sup_e_c_scaled": np.max, "final_norm": np.max,
}  # fmt: skip


@dataclass(frozen=True)
class SharedNetworkWork(SampledWork):
    """Computes draws of a grid point of a scenario with [[loops]].

    Loop k of draw i has the same plant, initial state and phase for any number of loops.
    """

    entries: tuple[str, ...] = ()
    """Names of the entries of [[loops]] at all grid points, if there are several."""

    judges: bool = False
    """Whether the claims of each loop are judged, which takes as long as the run."""

    count_from_s: float = 0.0
    """Updates that were sent earlier do not count in the last three columns of the row."""

    @property
    def row_type(self) -> np.dtype[np.void]:
        """The type of the rows: that of a run, and the mean cost of the loops of each entry."""
        return np.dtype([*LOOPS_ROW.descr, *((cost_of(name), "<f8") for name in self.entries)])

    def run(self, draws: range) -> NDArray[np.void]:
        """Compute consecutive draws; one row each."""
        rows = np.zeros(len(draws), self.row_type)
        for row, draw in zip(rows, draws, strict=True):
            seeds = seeds_of(self.seed, draw)
            shared = simulate_loops(self.scenario.model_copy(update={"seeds": seeds}))
            self.measure_loops(shared.loops, row)
        return rows

    def measure_loops(self, records: Sequence[RunRecord], row: np.void) -> None:
        """Fill a row from the records of the loops of a run."""
        loops = np.zeros(len(records), ROW)
        with np.errstate(all="ignore"):  # loops may diverge
            for own, record in zip(loops, records, strict=True):
                self._measure(record, own)
            if self.judges:
                held = [
                    all(one.verdict == ClaimVerdict.HELD for one in RunClaims(record).judge())
                    for record in records
                ]
        for name, of_all in _OF_ALL.items():
            row[name] = of_all(loops[name])
        row["diverged_at_s"] = np.nanmin(np.append(loops["diverged_at_s"], np.inf))
        row["status"] = OK
        row["cost_worst"] = np.max(loops["cost"])
        for name in self.entries:
            row[cost_of(name)] = np.nan
        if self.entries:
            sections = self.scenario.loops or ()
            ends = np.cumsum([one.count for one in sections])[:-1]
            for one, costs in zip(sections, np.split(loops["cost"], ends), strict=True):
                row[cost_of(one.name)] = np.mean(costs)
        row["loops_failed"] = np.mean(loops["status"] != OK)
        row["loops_claims_held"] = np.mean(held) if self.judges else np.nan
        self._measure_network(records, row)

    def _measure_network(self, records: Sequence[RunRecord], row: np.void) -> None:
        scenario = records[0].scenario
        counted = [_updates(record, self.count_from_s) for record in records]
        burst = scenario.network.longest_burst
        row["loops_guarantee_used"] = np.mean([used_up(one["fate"], burst) for one in counted])
        delays_ns = np.concatenate(
            [(one["release_ns"] - one["now_ns"])[effective(one["fate"])] for one in counted]
        )
        due_s = scenario.certificate.network_delay_s
        due_ns = scenario.timing.measurement_period_ns if due_s is None else due_s * NS_PER_S
        row["updates_late"] = np.mean(delays_ns > due_ns) if len(delays_ns) else 0.0
        row["delay_max_s"] = delays_ns.max(initial=0) / NS_PER_S


def cost_of(entry: str) -> str:
    """Return the column with the mean cost of the loops of an entry of [[loops]]."""
    return f"cost_of_{entry}"


def _updates(record: RunRecord, from_s: float) -> Rows:
    packets = record[NETEM_PACKET]
    counted: Rows = packets[(packets["flow"] == 0) & (packets["now_ns"] >= from_s * NS_PER_S)]
    return counted


def used_up(fates: NDArray[Any], burst: int) -> bool:
    """Whether ``burst`` ≥ 1 consecutive losses include one in a full queue."""
    losses = overflows = 0
    for fate, delivered in zip(fates, effective(fates), strict=True):
        losses = 0 if delivered else losses + 1
        overflows = 0 if delivered else overflows + (fate == Fate.OVERFLOWED)
        if overflows and losses >= burst:
            return True
    return False
