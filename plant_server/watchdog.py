"""The plant's watchdog: the input that is applied when no actuation has arrived for too long.

At t_k the newest actuation is too old if t_k − t > timeout. Here t is the time of the model state
x_c from which the actuation was computed; before the first actuation, t = 0. The policy then
determines the input:

* ``hold``: the newest input, unchanged;
* ``zero``: 0;
* ``model``: a predictive actuator. It applies the controller's input for the case that no update
  has arrived since t: u + K(x̂ − x_c) with x̂ = e^{H(t_k − t)} x_c. For this an actuation carries
  [u; x_c]. Since u = K x_c, the input equals K x̂. Before the controller's first update, x_c = 0
  and u is the safe input, so the input is the safe input. With zero-order hold (H = 0) it is u.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Propagator, Vector
from noack.core.ordered_arithmetic import product
from noack.protocol.machine_interface import Notice
from noack.protocol.record_tables import NO_SEQUENCE
from noack.protocol.wire_format import NO_VECTOR

NEVER_NS = 2**63 - 1
"""A timeout that no run reaches."""


class Actuation(NamedTuple):
    """An actuation as received by the plant."""

    u: Vector
    """The input, (m,)."""
    x_c: Vector
    """The controller's model state at ``t_ns``, (n,), with policy ``model``; else (0,)."""
    t_ns: int
    sequence: int


Fallback = Callable[[Actuation, int], Vector]
"""A policy: newest actuation and a time in ns at which it is too old → the input, (m,)."""


def hold(newest: Actuation, t_ns: int) -> Vector:
    """Return the newest input, of any age."""
    return newest.u


def zero(newest: Actuation, t_ns: int) -> Vector:
    """Return zero."""
    return np.zeros_like(newest.u)


class PredictedInput:
    """The input of the controller's model H, propagated from the last model state received.

    The state is advanced over the plant's step each time.
    """

    def __init__(self, H: Matrix, K: Matrix, period_ns: int) -> None:
        self._propagate = Propagator(H, (period_ns,))
        self._K = K
        self._from = NO_SEQUENCE
        self._t_ns = 0
        self._x = NO_VECTOR

    def __call__(self, newest: Actuation, t_ns: int) -> Vector:
        """Return u + K(e^{H(t − t_j)} x_c − x_c) for an actuation of time t_j."""
        if newest.sequence == NO_SEQUENCE:
            return newest.u
        if newest.sequence != self._from:
            self._from, self._x, self._t_ns = newest.sequence, newest.x_c, newest.t_ns
        self._x = self._propagate(self._x, t_ns - self._t_ns)
        self._t_ns = t_ns
        return newest.u + (product(self._K, self._x) - product(self._K, newest.x_c))


FALLBACK_NAMES = {"hold": "held", "zero": "0", "model": "the model's"}
"""The input that each policy applies, in words."""


def too_old(t_ns: Any, newest_ns: Any, timeout_ns: int) -> Any:
    """Whether an actuation of time ``newest_ns`` is too old at ``t_ns``; also of arrays."""
    return t_ns - newest_ns > timeout_ns


class Watchdog:
    """Chooses the plant's input at each step, and reports when the newest actuation is too old.

    The fallback chooses the input if the newest actuation is older than the timeout;
    ``input_name`` describes that input in notices.
    """

    def __init__(
        self,
        inputs: int,
        timeout_ns: int = NEVER_NS,
        fallback: Fallback = hold,
        input_name: str = "held",
    ) -> None:
        self._inputs = inputs
        self._timeout_ns = timeout_ns
        self._fallback = fallback
        self._input_name = input_name
        self._tripped_ns: int | None = None
        self.newest = Actuation(np.zeros(inputs), NO_VECTOR, 0, NO_SEQUENCE)

    def take(self, vector: Vector, t_ns: int, sequence: int) -> Actuation:
        """Store the vector of an actuation, u or [u; x_c]."""
        if len(vector) == self._inputs:
            self.newest = Actuation(vector, NO_VECTOR, t_ns, sequence)
            return self.newest
        u, x_c = vector[: self._inputs], vector[self._inputs :]
        # Slices are copied: a slice may have another memory layout than the vectors of a replay.
        self.newest = Actuation(u.copy(), x_c.copy(), t_ns, sequence)
        return self.newest

    def input(self, t_ns: int) -> tuple[Vector, tuple[Notice, ...]]:
        """Return the input that is applied from ``t_ns`` on, shape (m,), and notices."""
        newest, tripped_ns = self.newest, self._tripped_ns
        if not too_old(t_ns, newest.t_ns, self._timeout_ns):
            if tripped_ns is None:
                return newest.u, ()
            self._tripped_ns = None
            return newest.u, (arrives_again(t_ns, tripped_ns),)
        u = self._fallback(newest, t_ns)
        if tripped_ns is not None:
            return u, ()
        self._tripped_ns = t_ns
        none = newest.sequence == NO_SEQUENCE
        return u, (
            became_too_old(t_ns, newest.t_ns, self._timeout_ns, self._input_name, none=none),
        )


def arrives_again(t_ns: int, tripped_ns: int) -> Notice:
    """Return the notice of the first actuation in time after ``tripped_ns``."""
    lasted_s = (t_ns - tripped_ns) / NS_PER_S
    text = f"actuations arrive again; there was none in time for {lasted_s:.4g} s"
    return Notice(t_ns, "watchdog", text)


def became_too_old(
    t_ns: int, newest_ns: int, timeout_ns: int, input_name: str, *, none: bool
) -> Notice:
    """Return the notice of an actuation that is too old; ``none``: there has not been any."""
    age_s, timeout_s = ((ns / NS_PER_S) for ns in (t_ns - newest_ns, timeout_ns))
    what = "no actuation for" if none else "the newest actuation is too old:"
    text = f"{what} {age_s:.4g} s, {timeout_s:.4g} s allowed; the input is {input_name}"
    return Notice(t_ns, "watchdog", text)
