"""Exact identities that follow from the update laws alone, for every plant.

(I1)  x_c(t) − x_s(t) = Σ_{k=r+1..q} e^{H(t−t_k)} e_s(t_k⁻)

where q is the last event and r the last event with a packet that the controller received. It
extends the paper's eq:LossEv2 to every loss pattern: x_s jumps by −e_s(t_k⁻) at each event, and x_c
misses the jumps of events r + 1 to q.
"""

import numpy as np

from noack.core.linear_systems import Matrix, Propagator, Vector


class ModelDifference:
    """Evaluates the right-hand side of (I1) along a run; H is the matrix of both models."""

    def __init__(self, H: Matrix) -> None:
        self.propagate = Propagator(H)
        self._jumps: dict[int, tuple[int, Vector]] = {}
        self._t_ns = 0
        self._total = np.zeros(H.shape[0])
        self._is_old = False
        """Whether an update was received since the sum was computed."""

    def advance_to(self, t_ns: int) -> None:
        """Propagate the sum of the missed jumps to time ``t_ns``."""
        if self._jumps and t_ns != self._t_ns:
            self._total = self.propagate(self.total(), t_ns - self._t_ns)
        self._t_ns = t_ns

    @property
    def is_empty(self) -> bool:
        """Whether no event is missed, so that the sum is 0."""
        return not self._jumps

    def event(self, sequence: int, e_s: Vector) -> None:
        """Add event ``sequence`` at the present time with sensor error e_s(t_k⁻), shape (n,)."""
        self._total = self.total() + e_s
        self._jumps[sequence] = (self._t_ns, e_s)

    def received(self, sequence: int) -> None:
        """Remove the missed events up to ``sequence``: the controller received this update."""
        if self._jumps and next(iter(self._jumps)) <= sequence:  # events are in order
            self._jumps = {k: jump for k, jump in self._jumps.items() if k > sequence}
            self._is_old = True

    def total(self) -> Vector:
        """Return the sum of the missed jumps at the present time, shape (n,)."""
        if self._is_old:
            # Sum again instead of subtracting, so that rounding errors end at a delivery.
            terms = [self.propagate(e_s, self._t_ns - t_ns) for t_ns, e_s in self._jumps.values()]
            self._total = np.sum([np.zeros_like(self._total), *terms], axis=0)
            self._is_old = False
        return self._total
