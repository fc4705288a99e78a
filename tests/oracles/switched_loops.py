"""Systems that switch along the edges of a graph, in place of a loop, for proofs of their growth."""

from collections.abc import Sequence

import numpy as np
from flint import arb_mat

from netem.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from noack.core.balls import matrix
from noack.core.linear_systems import Matrix
from noack.proof.period_times import LoopTimes
from noack.proof.search.growth import Burst, PeriodicLoop
from noack.theory.time_triggered.graph import Graph
from noack.theory.witnesses.growth import enclose_growth


class SwitchedLoop(PeriodicLoop):
    """A loop whose bursts are given: sources, targets and matrices, each of one unit."""

    def __init__(self, edges: Sequence[tuple[int, int, Matrix]]) -> None:
        self.matrices_of = [np.array(M, dtype=float) for _, _, M in edges]
        # Ticks are far from transmissions, so that each update has one outcome.
        period = 10**9
        self.times = LoopTimes(period, period, period // 2, period, 0)
        self.between = range(1, 2)
        self.guarantee, self.size = LossGuarantee((LongestBurst(0),)), len(self.matrices_of[0])
        self.bursts = [Burst(v, w, number, 0, 0, 1) for number, (v, w, _) in enumerate(edges)]

    def under(self, guarantee: LossGuarantee) -> "SwitchedLoop":
        """Return the same system."""
        return self

    def matrix(self, burst: Burst) -> arb_mat:
        """Return the matrix of a burst, whose slot is its number."""
        return matrix(self.matrices_of[burst.slot].tolist())

    def upper(self, accuracy: float = 2e-4) -> float:
        """Return the bound of the growth that is proven."""
        return enclose_growth(self, accuracy).upper

    def fastest_cycle(self) -> tuple[float, tuple[int, ...]]:
        """Return the growth of the fastest cycle that is found, and its edges."""
        sources, targets = (
            np.array(ends) for ends in zip(*(burst[:2] for burst in self.bursts), strict=True)
        )
        matrices, graph = np.array(self.matrices_of), Graph(sources, targets, np.ones_like(sources))
        growth, cycle = graph.fastest_cycle(matrices, 20, 300)
        return float(np.exp(growth)), cycle
