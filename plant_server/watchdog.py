"""The plant's watchdog: which input is in force when no actuation has come for too long.

At t_k the newest actuation is too old if t_k − t > timeout, t the time of the model state x_c that
it was computed from; before the first one, t = 0. The input is then, by the declared policy,

* ``hold``: the newest one, still;
* ``zero``: 0;
* ``model``: what the controller would put out if nothing had reached it since, the predictive
  actuator: u + K(x̂ − x_c) with x̂ = e^{H(t_k − t)} x_c. An actuation carries [u; x_c] for this.
  Since u = K x_c this is K x̂; if the controller knew no state, x_c = 0 and u is its safe input,
  it is that; and if the model holds (H = 0), it is u.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Propagator, Vector
from noack.protocol.machine_interface import Notice
from noack.protocol.record_tables import NO_SEQUENCE
from noack.protocol.wire_format import NO_VECTOR

NEVER_NS = 2**63 - 1
"""A timeout that no run reaches."""


class Actuation(NamedTuple):
    """An actuation as the plant has it."""

    u: Vector
    """(m,)"""
    x_c: Vector
    """(n,) the controller's model state at ``t_ns``, with policy ``model``; else (0,)."""
    t_ns: int
    sequence: int


Fallback = Callable[[Actuation, int], Vector]
"""A policy: the newest actuation and a time at which it is too old, in ns → the input, (m,)."""


def hold(newest: Actuation, t_ns: int) -> Vector:
    """The newest input, however old."""
    return newest.u


def zero(newest: Actuation, t_ns: int) -> Vector:
    """No input."""
    return np.zeros_like(newest.u)


class PredictedInput:
    """The input that the controller's model asks for, from the last state of it that came.

    Args:
        H: what the controller's model integrates, shape (n, n), per second.
        K: gain, shape (m, n).
        period_ns: the plant's step, by which the state is advanced from one to the next.
    """

    def __init__(self, H: Matrix, K: Matrix, period_ns: int) -> None:
        self._propagate = Propagator(H, (period_ns,))
        self._K = K
        self._from = NO_SEQUENCE
        self._t_ns = 0
        self._x = NO_VECTOR

    def __call__(self, newest: Actuation, t_ns: int) -> Vector:
        """Return u + K(e^{H(t − t_j)} x_c − x_c) of an actuation of time t_j."""
        if newest.sequence == NO_SEQUENCE:
            return newest.u
        if newest.sequence != self._from:
            self._from, self._x, self._t_ns = newest.sequence, newest.x_c, newest.t_ns
        self._x = self._propagate(self._x, t_ns - self._t_ns)
        self._t_ns = t_ns
        predicted: Vector = newest.u + (self._K @ self._x - self._K @ newest.x_c)
        return predicted


@overload
def too_old(t_ns: int, newest_ns: int, timeout_ns: int) -> bool: ...
@overload
def too_old(
    t_ns: NDArray[np.int64], newest_ns: NDArray[np.int64], timeout_ns: int
) -> NDArray[np.bool_]: ...
def too_old(t_ns: Any, newest_ns: Any, timeout_ns: int) -> Any:
    """Whether an actuation of time ``newest_ns`` is too old at ``t_ns``."""
    return t_ns - newest_ns > timeout_ns


class Watchdog:
    """Chooses the plant's input at each step, and says when the newest actuation is too old.

    Args:
        inputs: m.
        timeout_ns: how old an actuation may be.
        fallback: what is done about one that is older.
        said: what the input is then, in words.
    """

    def __init__(
        self,
        inputs: int,
        timeout_ns: int = NEVER_NS,
        fallback: Fallback = hold,
        said: str = "held",
    ) -> None:
        self._inputs = inputs
        self._timeout_ns = timeout_ns
        self._fallback = fallback
        self._said = said
        self._tripped_ns: int | None = None
        self.newest = Actuation(np.zeros(inputs), NO_VECTOR, 0, NO_SEQUENCE)

    def take(self, vector: Vector, t_ns: int, sequence: int) -> Actuation:
        """Take what an actuation carries, u or [u; x_c]."""
        u, x_c = vector[: self._inputs], vector[self._inputs :]
        # A part of an array may lie in memory otherwise than a copy, and replay has copies.
        self.newest = Actuation(u.copy(), x_c.copy(), t_ns, sequence)
        return self.newest

    def input(self, t_ns: int) -> tuple[Vector, tuple[Notice, ...]]:
        """Return the input that is in force from ``t_ns`` on, shape (m,), and what is to be said.

        Args:
            t_ns: time of the step; not before that of the last call.
        """
        newest, tripped_ns = self.newest, self._tripped_ns
        if not too_old(t_ns, newest.t_ns, self._timeout_ns):
            if tripped_ns is None:
                return newest.u, ()
            self._tripped_ns = None
            lasted_s = (t_ns - tripped_ns) / NS_PER_S
            text = f"actuations are back; there was none in time for {lasted_s:.4g} s"
            return newest.u, (Notice(t_ns, "watchdog", text),)
        u = self._fallback(newest, t_ns)
        if tripped_ns is not None:
            return u, ()
        self._tripped_ns = t_ns
        age_s, timeout_s = ((ns / NS_PER_S) for ns in (t_ns - newest.t_ns, self._timeout_ns))
        none = newest.sequence == NO_SEQUENCE
        what = "there has been no actuation for" if none else "the newest actuation is as old as"
        text = f"{what} {age_s:.4g} s, {timeout_s:.4g} s allowed: the input is {self._said}"
        return u, (Notice(t_ns, "watchdog", text),)
