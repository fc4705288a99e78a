"""Exact identities that follow from the update laws alone, whatever the plant.

(I1)  x_c(t) − x_s(t) = Σ_{k=r+1..q} e^{H(t−t_k)} e_s(t_k⁻)

with r the last event whose packet the controller has, q the last event. It extends the paper's
eq:LossEv2 to every drop pattern: x_s jumped by −e_s(t_k⁻) at each event; x_c missed those jumps.
"""

import numpy as np

from noack.linear import Matrix, Propagator, Vector


class MissedJumps:
    """Evaluates the right-hand side of (I1) along a run.

    Args:
        H: what both models integrate between updates, shape (n, n), per second.
    """

    def __init__(self, H: Matrix) -> None:
        self._propagate = Propagator(H)
        self._terms: dict[int, Vector] = {}
        self._t_ns = 0

    def advance_to(self, t_ns: int) -> None:
        """Propagate every missed jump to time ``t_ns``."""
        dt_ns = t_ns - self._t_ns
        self._t_ns = t_ns
        for sequence, term in self._terms.items():
            self._terms[sequence] = self._propagate(term, dt_ns)

    def event(self, sequence: int, e_s: Vector) -> None:
        """Event ``sequence`` happens now with sensor error e_s(t_k⁻), shape (n,)."""
        self._terms[sequence] = e_s

    def received(self, sequence: int) -> None:
        """The controller now has event ``sequence``; it and all before it are missed no more."""
        for older in [k for k in self._terms if k <= sequence]:
            del self._terms[older]

    def total(self) -> Vector:
        """Σ of the missed jumps at the present time, shape (n,)."""
        zero = np.zeros(self._propagate.generator.shape[0])
        return np.sum(list(self._terms.values()), axis=0) if self._terms else zero
