"""The controller: runs the model x_c, reset only by the updates that survive (eq:ModCont).

An update in → x_c ← e^{H(t−t_i)} x(t_i), so that a late packet still restores x_c = x_s. Every
tick: u = K x_c out, or a declared safe input as long as it knows no state: until its first update,
if it does not know x(0). The model's time advances with ticks and updates and never runs backward:
an update older than the last tick is propagated to it; one that is newer takes the model with it.
"""

from collections.abc import Sequence

import numpy as np

from noack.config.parameter_changes import ChangeSchedule, ParameterChange
from noack.config.resolution import loop_of, setpoint_of
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.core.model_flow import ModelFlow
from noack.protocol.machine_interface import BEGINNING, GENERATION, Notice, Output, Record, Start
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_SETTING, CONTROLLER_STEP
from noack.protocol.wire_format import NO_VECTOR, Flow, Message


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
        start: where in the run it takes up its work.
        safe_input: what it puts out while it knows no state, shape (m,); by default 0.
        predictive: whether an actuation carries x_c, too, for the plant to go on with.
        setpoint: x_r and u_r, shapes (n,) and (m,): u = K(x_c − x_r) + u_r; None is 0.
        schedule: what it knows of changes; None if there are none.
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
        start: Start = BEGINNING,
        safe_input: Vector | None = None,
        predictive: bool = False,
        setpoint: tuple[Vector, Vector] | None = None,
        schedule: ChangeSchedule | None = None,
    ) -> None:
        steps_ns = (period_ns, phase_ns, period_ns - phase_ns)
        self._flow = ModelFlow(H, steps_ns, None if setpoint is None else setpoint[0])
        self._setpoint = setpoint
        self._schedule = schedule
        self._reached_ns = -1
        self._newest_ns = 0
        self._K = K
        self._period_ns = period_ns
        self._phase_ns = phase_ns
        self._horizon_ns = horizon_ns
        self._mansd = mansd
        self._known_start = x0 is not None
        self._acknowledges = acknowledges
        self._safe_input = np.zeros(len(K)) if safe_input is None else safe_input
        self._predictive = predictive
        self._knows_state = x0 is not None
        self._inputs = self._first_number = start.first_number
        self._step = max(-(-(start.from_ns - phase_ns) // period_ns), 0)
        # What went by before a restart, nobody knows.
        self._newest: int | None = None if start.is_restart else -1
        # A model without a state waits for the first tick, which is on record, as its start is not.
        self._model_ns = phase_ns + self._step * period_ns if start.is_restart else 0
        self.x_c = np.zeros(H.shape[0]) if x0 is None else x0

    def next_deadline_ns(self) -> int | None:
        """Time of the next tick."""
        t_ns = self._phase_ns + self._step * self._period_ns
        return t_ns if t_ns <= self._horizon_ns else None

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Take a change; it is in force from the first tick on that is not before T.

        x_c follows another set-point from T itself on.
        """
        if self._schedule is None:
            raise CallerError("this controller's settings cannot be changed")
        number = self._inputs
        said = self._schedule.announce(CONTROLLER_SETTING, change, number, now_ns, self._reached_ns)
        self._inputs += 1
        return said

    def _change(self, t_ns: int) -> None:
        """Apply what is in force at a time."""
        while self._schedule is not None and (found := self._schedule.take(t_ns)) is not None:
            self._mansd = found.scenario.network.mansd
            self._setpoint = found.prepared
            self._flow.change(found.since_ns, self._setpoint and self._setpoint[0])

    def _allowed(self, since_ns: int, now_ns: int) -> int:
        """The most successive dropouts that any cap allows that was in force since a time."""
        if self._schedule is None:
            return self._mansd
        return max(one.network.mansd for one in self._schedule.between(since_ns, now_ns))

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Take an update x(t_i); count the dropouts before it from the sequence numbers."""
        event_ns = message.t_ns
        model_ns = max(self._model_ns, event_ns)
        if self._schedule is not None and self._schedule.next_ns is not None:
            self._change(model_ns)
        before = self._flow(self.x_c, self._model_ns, model_ns)
        self.x_c = self._flow(message.vector, event_ns, model_ns)
        self._model_ns = self._reached_ns = model_ns
        self._knows_state = True
        newest, self._newest = self._newest, message.sequence
        dropouts = 0 if newest is None else _between(newest, message.sequence)
        row = (
            self._count(), message.sequence, event_ns, now_ns, model_ns,
            message.vector, before, self.x_c, dropouts,
        )  # fmt: skip
        outputs: list[Output] = [Record(CONTROLLER_DELIVERY, row)]
        if self._acknowledges:
            answer = Message(Flow.ACKNOWLEDGEMENT, message.sequence, event_ns, NO_VECTOR)
            outputs.insert(0, answer)
        newest_ns, self._newest_ns = self._newest_ns, event_ns
        allowed = self._mansd
        if dropouts > allowed:  # they may have been allowed when they happened
            allowed = self._allowed(newest_ns, max(now_ns, event_ns))
        if dropouts > allowed:
            outputs.append(
                Notice(
                    event_ns,
                    "violation",
                    f"MANSD violated: {dropouts} successive dropouts before update "
                    f"{message.sequence}, at most {allowed} assumed",
                )
            )
        elif newest == -1 and dropouts > 0 and not self._known_start:
            outputs.append(
                Notice(
                    event_ns,
                    "violation",
                    f"no delivered t_0: {dropouts} updates were lost before the first delivery",
                )
            )
        return outputs

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Advance x_c to the tick and put out u = K x_c, with the model's time."""
        step, t_ns = self._step, self._phase_ns + self._step * self._period_ns
        if self._schedule is not None and self._schedule.next_ns is not None:
            self._change(max(t_ns, self._model_ns))
        if t_ns > self._model_ns:
            self.x_c = self._flow(self.x_c, self._model_ns, t_ns)
            self._model_ns = t_ns
        self._reached_ns = self._model_ns
        self._step += 1
        u = self._input() if self._knows_state else self._safe_input
        number = self._first_number + step
        row = (self._count(), number, t_ns, now_ns, self._model_ns, self.x_c, u)
        carried = np.concatenate([u, self.x_c]) if self._predictive else u
        actuation = Message(Flow.ACTUATION, number, self._model_ns, carried)
        return (actuation, Record(CONTROLLER_STEP, row))

    def _input(self) -> Vector:
        """The control law, of the set-point in force."""
        u: Vector = self._K @ self.x_c
        if self._setpoint is not None:
            x_r, u_r = self._setpoint
            u = self._K @ (self.x_c - x_r) + u_r
        return u

    def _count(self) -> int:
        self._inputs += 1
        return self._inputs - 1


def _between(newest: int, sequence: int) -> int:
    """How many updates the sensor has sent between two; before its restart nobody knows."""
    again = sequence // GENERATION != newest // GENERATION
    return sequence % GENERATION if again else sequence - newest - 1


def controller_of(resolved: Scenario, start: Start = BEGINNING) -> Controller:
    """Return the controller of a resolved scenario; of the plant it learns x(0) at the most."""
    loop = loop_of(resolved)
    known = resolved.network.initial_sync == "known_state" and not start.is_restart
    safe_input = resolved.controller.safe_input
    return Controller(
        loop.H,
        loop.K,
        period_ns=resolved.timing.controller_period_ns,
        phase_ns=resolved.timing.controller_phase_ns,
        horizon_ns=resolved.timing.horizon_ns,
        mansd=resolved.network.mansd,
        x0=loop.x0 if known else None,
        acknowledges=resolved.is_acknowledged,
        start=start,
        safe_input=None if safe_input is None else np.array(safe_input),
        predictive=resolved.message_sizes.is_predictive,
        setpoint=setpoint_of(resolved),
        schedule=None if resolved.is_acknowledged else ChangeSchedule(resolved, setpoint_of),
    )
