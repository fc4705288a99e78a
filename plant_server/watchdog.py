"""The plant's watchdog: the input that is applied when no actuation has arrived for too long.

At t_k the newest actuation is too old if t_k − t > timeout. Here t is the time of the model state
x_c from which the actuation was computed; before the first actuation, t = 0. Until then its inputs
are applied (:mod:`plant_server.input_buffer`). The policy then determines the input:

* ``hold``: the last input of the newest actuation;
* ``zero``: 0;
* ``model``: a predictive actuator. It applies the controller's input for the case that no update
  has arrived since t: u + K(x̂ − x_c) with x̂ = e^{H(t_k − t)} x_c. For this an actuation carries
  [u; x_c]. Since u = K x_c, the input equals K x̂. Before the controller's first update, x_c = 0
  and u is the safe input, so the input is the safe input. With zero-order hold (H = 0) it is u.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from noack.core.clock import NS_PER_S
from noack.core.linear_systems import Matrix, Propagator, Vector
from noack.core.ordered_arithmetic import product
from noack.protocol.machine_interface import Notice
from noack.protocol.record_tables import NO_SEQUENCE
from noack.protocol.wire_format import NO_VECTOR
from plant_server.input_buffer import Actuation, InputBuffer

NEVER_NS = 2**63 - 1
"""A timeout that no run reaches."""


Fallback = Callable[[Actuation, int], Vector]
"""A policy: newest actuation and a time in ns at which it is too old → the input, (m,)."""


def hold(newest: Actuation, t_ns: int) -> Vector:
    """Return the last input of the actuation, of any age."""
    u: Vector = newest.inputs[-1]
    return u


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

    Args:
        buffer: has the newest actuation.
        timeout_ns: the fallback chooses the input if the actuation is older.
        fallback: the policy.
        input_name: describes the input of the fallback in notices.
        notice_ns: age from which a notice reports it; at least the timeout.
    """

    def __init__(
        self,
        buffer: InputBuffer,
        timeout_ns: int = NEVER_NS,
        fallback: Fallback = hold,
        input_name: str = "held",
        notice_ns: int = 0,
    ) -> None:
        self._buffer = buffer
        self.take = buffer.take
        self._timeout_ns = timeout_ns
        self._fallback = fallback
        self._input_name = input_name
        self._notice_ns = max(notice_ns, timeout_ns)
        self._noticed_ns: int | None = None

    @property
    def newest(self) -> Actuation:
        """The newest actuation."""
        return self._buffer.newest

    def input(self, t_ns: int) -> tuple[Vector, int, tuple[Notice, ...]]:
        """Return the input that is applied from ``t_ns`` on, shape (m,), and notices.

        Between them is the number of the input in the newest actuation; −1: of the fallback.
        """
        newest_ns = self._buffer.newest.t_ns
        if too_old(t_ns, newest_ns, self._timeout_ns):
            u, entry = self._fallback(self._buffer.newest, t_ns), -1
        else:
            u, entry = self._buffer.due(t_ns)
        if too_old(t_ns, newest_ns, self._notice_ns) == (self._noticed_ns is not None):
            return u, entry, ()
        return u, entry, (self._notice(t_ns),)

    def _notice(self, t_ns: int) -> Notice:
        """Report that actuations are missing, or that they arrive again."""
        newest, noticed_ns = self._buffer.newest, self._noticed_ns
        self._noticed_ns = t_ns if noticed_ns is None else None
        if noticed_ns is not None:
            return arrive_again(t_ns, noticed_ns)
        none = newest.sequence == NO_SEQUENCE
        return are_missing(t_ns, newest.t_ns, self._timeout_ns, self._input_name, none=none)


def arrive_again(t_ns: int, noticed_ns: int) -> Notice:
    """Return the notice of the first actuation after those reported missing at ``noticed_ns``."""
    lasted_s = (t_ns - noticed_ns) / NS_PER_S
    text = f"actuations arrive again; there was none in time for {lasted_s:.4g} s"
    return Notice(t_ns, "watchdog", text)


def are_missing(
    t_ns: int, newest_ns: int, timeout_ns: int, input_name: str, *, none: bool
) -> Notice:
    """Return the notice of a newest actuation that is too old; ``none``: there is none."""
    age_s, timeout_s = ((ns / NS_PER_S) for ns in (t_ns - newest_ns, timeout_ns))
    what = "no actuation for" if none else "the newest actuation is too old:"
    text = f"{what} {age_s:.4g} s, {timeout_s:.4g} s allowed; the input is {input_name}"
    return Notice(t_ns, "watchdog", text)
