"""Exact identities that follow from the update laws alone, for every plant.

(I1)  x_c(t) − x_s(t) = Σ_{k=r+1..q} e^{H(t−t_k)} e_s(t_k⁻)

where q is the last event and r the last event with a packet that the controller received. It
extends the paper's eq:LossEv2 to every loss pattern: x_s jumps by −e_s(t_k⁻) at each event, and x_c
misses the jumps of events r + 1 to q.
"""

from collections import deque

import numpy as np

from noack.core.linear_systems import Matrix, Propagator, Vector


class ModelDifference:
    """Evaluates the right-hand side of (I1) along a run; H is the matrix of both models.

    The missed events are a queue: the oldest leave it. The sums over the older part, from each of
    its events on, are kept at one time; the newer part has one sum. So an event costs a few
    products, however many are missed, and nothing is subtracted: rounding errors do not stay.
    """

    def __init__(self, H: Matrix) -> None:
        self.propagate = Propagator(H)
        self._t_ns = 0
        self._older: deque[tuple[int, Vector]] = deque()
        """Sequence number, and the sum of the jumps from this event on, at time ``_older_ns``."""
        self._older_ns = 0
        self._newer: list[tuple[int, int, Vector]] = []
        """Sequence number, time, and jump."""
        self._zero = self._newer_sum = np.zeros(H.shape[0])

    def advance_to(self, t_ns: int) -> None:
        """Propagate the sum of the missed jumps to time ``t_ns``."""
        if self._newer and t_ns != self._t_ns:
            self._newer_sum = self.propagate(self._newer_sum, t_ns - self._t_ns)
        self._t_ns = t_ns

    @property
    def is_empty(self) -> bool:
        """Whether no event is missed, so that the sum is 0."""
        return not self._older and not self._newer

    def event(self, sequence: int, e_s: Vector) -> None:
        """Add event ``sequence`` at the present time with sensor error e_s(t_k⁻), shape (n,)."""
        self._newer_sum = self._newer_sum + e_s
        self._newer.append((sequence, self._t_ns, e_s))

    def received(self, sequence: int) -> None:
        """Remove the missed events up to ``sequence``: the controller received this update."""
        while self._older and self._older[0][0] <= sequence:
            self._older.popleft()
        if self._older or not self._newer or self._newer[0][0] > sequence:
            return
        total, self._older_ns = self._zero, self._t_ns
        for number, t_ns, e_s in reversed(self._newer):
            if number <= sequence:
                break
            total = total + self.propagate(e_s, self._t_ns - t_ns)
            self._older.appendleft((number, total))
        self._newer, self._newer_sum = [], self._zero

    def total(self) -> Vector:
        """Return the sum of the missed jumps at the present time, shape (n,)."""
        if not self._older:
            return self._newer_sum
        older = self.propagate(self._older[0][1], self._t_ns - self._older_ns)
        return older + self._newer_sum
