"""Runs of a campaign with several loops on one network, in virtual time.

Numbers of transmissions and deliveries are those of all loops; the cost is the mean over the loops.
Times, errors and loss bursts are those of the worst loop.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.claims.claims_by_part import RunClaims
from cosim.analysis.summary_model import ClaimVerdict
from cosim.simulation.batch.batch_interface import ROW
from cosim.simulation.batch.batch_status import OK
from cosim.simulation.shared_network import simulate_loops
from cosim.studies.campaign.random_draws import seeds_of
from cosim.studies.campaign.sampled_draws import SampledWork

SHARED_ROW = np.dtype(
    [*ROW.descr, ("cost_worst", "<f8"), ("loops_failed", "<f8"), ("loops_claims_held", "<f8")]
)
"""The row of a run of several loops.

cost_worst: the largest cost of a loop. loops_failed: share of the loops that diverged or exceeded
the largest number of events. loops_claims_held: share of the loops of which every claim held.
"""
_OF_ALL: Mapping[str, Callable[[NDArray[Any]], Any]] = {
    "transmissions": np.sum, "deliveries": np.sum, "longest_loss_burst": np.max,
    "inter_event_min_s": np.min, "inter_event_mean_s": np.mean, "settling_s": np.max,
    "cost": np.mean, "sup_e_c_scaled": np.max, "final_norm": np.max,
}  # fmt: skip


@dataclass(frozen=True)
class SharedWork(SampledWork):
    """Computes draws of a grid point with several loops; the scenario has [[loops]].

    Loop k of draw i has the same plant, initial state and phase for any number of loops.
    """

    judges: bool = False
    """Whether the claims of each loop are judged, which takes as long as the run."""

    def run(self, draws: range) -> NDArray[np.void]:
        """Compute consecutive draws; one row of :data:`SHARED_ROW` each."""
        rows = np.zeros(len(draws), SHARED_ROW)
        for row, draw in zip(rows, draws, strict=True):
            seeds = seeds_of(self.seed, draw)
            shared = simulate_loops(self.scenario.model_copy(update={"seeds": seeds}))
            loops = np.zeros(len(shared.loops), ROW)
            with np.errstate(all="ignore"):  # loops may diverge
                for own, record in zip(loops, shared.loops, strict=True):
                    self._measure(record, own)
                if self.judges:
                    held = [
                        all(one.verdict == ClaimVerdict.HELD for one in RunClaims(record).judge())
                        for record in shared.loops
                    ]
            for name, of_all in _OF_ALL.items():
                row[name] = of_all(loops[name])
            row["diverged_at_s"] = np.nanmin(np.append(loops["diverged_at_s"], np.inf))
            row["status"] = OK
            row["cost_worst"] = np.max(loops["cost"])
            row["loops_failed"] = np.mean(loops["status"] != OK)
            row["loops_claims_held"] = np.mean(held) if self.judges else np.nan
        return rows
