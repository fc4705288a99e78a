"""The controller: runs the model x_c, reset only by the updates that survive (eq:ModCont).

An update in → x_c ← e^{H(t−t_i)} x(t_i), so that a late packet still restores x_c = x_s. Every
tick: u = K x_c out. The model's time advances with ticks and updates and never runs backward: an
update older than the last tick is propagated to it; one that is newer takes the model with it.
"""

from collections.abc import Sequence

import numpy as np

from noack.linear import Matrix, Propagator, Vector
from noack.machine import Notice, Output, Record
from noack.records import CONTROLLER_DELIVERY, CONTROLLER_STEP
from noack.resolve import loop_of
from noack.scenario import Scenario
from noack.wire import NO_VECTOR, Flow, Message


class Controller:
    """The machine of the controller node.

    Args:
        H: what the model integrates between updates, shape (n, n), per second.
        K: gain, shape (m, n).
        period_ns: time between two control inputs.
        phase_ns: time of the first.
        horizon_ns: no tick is due after this time.
        mansd: M − 1; more successive dropouts than this violate the assumption.
        x0: the state that sensor and controller both know at t = 0; None if they do not.
        acknowledges: whether it acknowledges the updates that it takes, as the baseline does.
    """

    def __init__(
        self,
        H: Matrix,
        K: Matrix,
        *,
        period_ns: int,
        phase_ns: int,
        horizon_ns: int,
        mansd: int,
        x0: Vector | None = None,
        acknowledges: bool = False,
    ) -> None:
        self._propagate = Propagator(H, (period_ns, phase_ns, period_ns - phase_ns))
        self._K = K
        self._period_ns = period_ns
        self._phase_ns = phase_ns
        self._horizon_ns = horizon_ns
        self._mansd = mansd
        self._known_start = x0 is not None
        self._acknowledges = acknowledges
        self._inputs = 0
        self._step = 0
        self._last_sequence = -1
        self._model_ns = 0
        self.x_c = np.zeros(H.shape[0]) if x0 is None else x0

    def next_deadline_ns(self) -> int | None:
        """Time of the next tick."""
        t_ns = self._phase_ns + self._step * self._period_ns
        return t_ns if t_ns <= self._horizon_ns else None

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Take an update x(t_i); count the dropouts before it from the sequence numbers."""
        event_ns = message.t_ns
        model_ns = max(self._model_ns, event_ns)
        before = self._propagate(self.x_c, model_ns - self._model_ns)
        self.x_c = self._propagate(message.vector, model_ns - event_ns)
        self._model_ns = model_ns
        dropouts = message.sequence - self._last_sequence - 1
        row = (
            self._count(), message.sequence, event_ns, now_ns, model_ns,
            message.vector, before, self.x_c, dropouts,
        )  # fmt: skip
        outputs: list[Output] = [Record(CONTROLLER_DELIVERY, row)]
        if self._acknowledges:
            answer = Message(Flow.ACKNOWLEDGEMENT, message.sequence, event_ns, NO_VECTOR)
            outputs.insert(0, answer)
        if dropouts > self._mansd:
            outputs.append(
                Notice(
                    event_ns,
                    "violation",
                    f"MANSD violated: {dropouts} successive dropouts before update "
                    f"{message.sequence}, at most {self._mansd} assumed",
                )
            )
        elif self._last_sequence < 0 and dropouts > 0 and not self._known_start:
            outputs.append(
                Notice(
                    event_ns,
                    "violation",
                    f"no delivered t_0: {dropouts} updates were lost before the first delivery",
                )
            )
        self._last_sequence = message.sequence
        return outputs

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Advance x_c to the tick and put out u = K x_c."""
        step, t_ns = self._step, self._phase_ns + self._step * self._period_ns
        if t_ns > self._model_ns:
            self.x_c = self._propagate(self.x_c, t_ns - self._model_ns)
            self._model_ns = t_ns
        self._step += 1
        u = self._K @ self.x_c
        row = (self._count(), step, t_ns, now_ns, self._model_ns, self.x_c, u)
        return (Message(Flow.ACTUATION, step, t_ns, u), Record(CONTROLLER_STEP, row))

    def _count(self) -> int:
        self._inputs += 1
        return self._inputs - 1


def controller_of(resolved: Scenario) -> Controller:
    """Return the controller of a resolved scenario; of the plant it learns x(0) at the most."""
    loop = loop_of(resolved)
    known = resolved.network.initial_sync == "known_state"
    return Controller(
        loop.H,
        loop.K,
        period_ns=resolved.controller_period_ns,
        phase_ns=resolved.controller_phase_ns,
        horizon_ns=resolved.horizon_ns,
        mansd=resolved.network.mansd,
        x0=loop.x0 if known else None,
        acknowledges=resolved.is_acknowledged,
    )
