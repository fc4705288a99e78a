"""The controller: runs the model x_c, which only a delivered update resets (eq:ModCont).

At an update x_c ← e^{H(t−t_i)} x(t_i), so that a late update still restores x_c = x_s. At every
tick the controller sends the input of its control law: u = K x_c, unless the scenario names another
law. Before its first update it sends a declared safe input, unless x(0) is given. The model's time
advances with ticks and updates and never runs backward. An update older than the last tick is
propagated to the time of that tick. A newer update advances the model to its own time.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from controller_node.loss_check import LossCheck, lost_between
from noack.config.parameter_changes import ChangeSchedule, ParameterChange
from noack.config.resolution import loop_of, setpoint_of
from noack.config.scenario import Scenario
from noack.controllers.controller_settings import ControlFailedError, ControlLaw, ControlModel
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.core.model_flow import ModelFlow
from noack.impairments.loss_guarantee import LossGuarantee
from noack.protocol.machine_interface import (
    BEGINNING,
    FAILED,
    Notice,
    Output,
    Record,
    Start,
)
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_SETTING, CONTROLLER_STEP
from noack.protocol.wire_format import NO_VECTOR, Flow, Message


class Controller:
    """The machine of the controller node.

    Args:
        H: what the model integrates between updates, shape (n, n), per second.
        law: the control law.
        inputs: m.
        period_ns: time between two control inputs.
        phase_ns: time of the first.
        horizon_ns: no tick is due after this time.
        guarantee: losses that it does not allow violate the assumption.
        x0: x(0), if sensor and controller start from it; else None.
        acknowledges: whether it acknowledges each update, as the acknowledgement baseline does.
        start: the beginning of the run, or a restart during the run.
        safe_input: the input before the first update, shape (m,); by default 0.
        predictive: whether an actuation also carries x_c, for the plant's watchdog.
        predictions: number of inputs of an actuation: that of the tick, and those for the
            following ticks if no update arrives until then; only with a linear law.
        setpoint: x_r and u_r, shapes (n,) and (m,): u = K(x_c − x_r) + u_r; None is 0.
        schedule: the announced changes of its settings; None if they cannot change.
    """

    def __init__(
        self,
        H: Matrix,
        law: ControlLaw,
        *,
        inputs: int,
        period_ns: int,
        phase_ns: int,
        horizon_ns: int,
        guarantee: LossGuarantee,
        x0: Vector | None = None,
        acknowledges: bool = False,
        start: Start = BEGINNING,
        safe_input: Vector | None = None,
        predictive: bool = False,
        predictions: int = 1,
        setpoint: tuple[Vector, Vector] | None = None,
        schedule: ChangeSchedule | None = None,
    ) -> None:
        steps_ns = (period_ns, phase_ns, period_ns - phase_ns)
        self._flow = ModelFlow(H, steps_ns, None if setpoint is None else setpoint[0])
        self._setpoint = setpoint
        self._schedule = schedule
        self._reached_ns = -1
        self._law: ControlLaw | None = law
        self._period_ns = period_ns
        self._phase_ns = phase_ns
        self._horizon_ns = horizon_ns
        self._losses = LossCheck(guarantee, schedule, known_start=x0 is not None)
        self._acknowledges = acknowledges
        self._safe_input = np.zeros(inputs) if safe_input is None else safe_input
        self._predictive, self._predictions = predictive, predictions
        self._knows_state = x0 is not None
        self._inputs = self._first_number = start.first_number
        self._step = max(-(-(start.from_ns - phase_ns) // period_ns), 0)
        # After a restart the updates before it are unknown.
        self._newest: int | None = None if start.is_restart else -1
        # A model without a state starts at the first tick: the tick is recorded, the start is not.
        self._model_ns = phase_ns + self._step * period_ns if start.is_restart else 0
        self.x_c = np.zeros(H.shape[0]) if x0 is None else x0

    def next_deadline_ns(self) -> int | None:
        """Time of the next tick."""
        t_ns = self._phase_ns + self._step * self._period_ns
        return t_ns if t_ns <= self._horizon_ns else None

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        """Schedule a change; it takes effect at the first tick at or after its time T.

        x_c follows the new set point from T itself on.
        """
        if self._schedule is None:
            raise CallerError("this controller's settings cannot be changed")
        outputs = self._schedule.announce(
            CONTROLLER_SETTING, change, self._inputs, now_ns, self._reached_ns
        )
        self._inputs += 1
        return outputs

    def _change(self, t_ns: int) -> None:
        """Apply the changes that are due at a time."""
        while self._schedule is not None and (due := self._schedule.take(t_ns)) is not None:
            self._losses.change(due.scenario.network.guarantee, due.since_ns)
            self._setpoint = due.prepared
            self._flow.change(due.since_ns, self._setpoint and self._setpoint[0])

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Process an update x(t_i); count the losses before it from the sequence numbers."""
        event_ns = message.t_ns
        model_ns = max(self._model_ns, event_ns)
        if self._schedule is not None and self._schedule.next_ns is not None:
            self._change(model_ns)
        before = self._flow(self.x_c, self._model_ns, model_ns)
        self.x_c = self._flow(message.vector, event_ns, model_ns)
        self._model_ns = self._reached_ns = model_ns
        self._knows_state = True
        newest, self._newest = self._newest, message.sequence
        losses = 0 if newest is None else lost_between(newest, message.sequence)
        row = (
            self._count(), message.sequence, event_ns, now_ns, model_ns,
            message.vector, before, self.x_c, losses,
        )  # fmt: skip
        outputs: list[Output] = [Record(CONTROLLER_DELIVERY, row)]
        if self._acknowledges:
            answer = Message(Flow.ACKNOWLEDGEMENT, message.sequence, event_ns, NO_VECTOR)
            outputs.insert(0, answer)
        _, failed = self._apply(
            event_ns, lambda law: law.update(event_ns / NS_PER_S, message.vector)
        )
        violations = self._losses.add(message.sequence, newest, losses, event_ns, now_ns)
        return [*outputs, *failed, *violations]

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Advance x_c to the tick and send the control input, with the model's time."""
        step, t_ns = self._step, self._phase_ns + self._step * self._period_ns
        if self._schedule is not None and self._schedule.next_ns is not None:
            self._change(max(t_ns, self._model_ns))
        if t_ns > self._model_ns:
            self.x_c = self._flow(self.x_c, self._model_ns, t_ns)
            self._model_ns = t_ns
        self._reached_ns = self._model_ns
        self._step += 1
        u: Vector = self._safe_input
        failed: Sequence[Notice] = ()
        if self._knows_state:
            u, failed = self._input(self.x_c, t_ns)
        number = self._first_number + step
        row = (self._count(), number, t_ns, now_ns, self._model_ns, self.x_c, u)
        carried = u
        if self._predictive or self._predictions > 1:
            x_c = (self.x_c,) if self._predictive else ()
            carried = np.concatenate([u, *self._predicted(u), *x_c])
        actuation = Message(Flow.ACTUATION, number, self._model_ns, carried)
        return (actuation, Record(CONTROLLER_STEP, row), *failed)

    def _predicted(self, u: Vector) -> Iterator[Vector]:
        """Yield the inputs for the times one period, two periods … after the model's time."""
        x, t_ns = self.x_c, self._model_ns
        for _ in range(1, self._predictions):
            if self._knows_state:
                x, t_ns = self._flow(x, t_ns, t_ns + self._period_ns), t_ns + self._period_ns
                u, _ = self._input(x, t_ns)
            yield u

    def _input(self, x: Vector, t_ns: int) -> tuple[Vector, Sequence[Notice]]:
        """Return the input for a state of the model at a time, and a failure of the law."""
        return self._apply(t_ns, lambda law: law.input(t_ns / NS_PER_S, x, self._setpoint))

    def _apply(
        self, t_ns: int, method: Callable[[ControlLaw], Vector | None]
    ) -> tuple[Vector, Sequence[Notice]]:
        """Call the control law; after its first failure, the input is the safe input."""
        if self._law is None:
            return self._safe_input, ()
        try:
            u = method(self._law)
        except ControlFailedError as error:
            self._law = None
            return self._safe_input, (Notice(t_ns, FAILED, str(error)),)
        return (self._safe_input if u is None else u), ()

    def _count(self) -> int:
        self._inputs += 1
        return self._inputs - 1


def law_of(resolved: Scenario) -> ControlLaw:
    """Return the control law of a resolved scenario.

    Raises:
        CallerError: the user's class does not exist, raises, or lacks a required method.
    """
    loop, period_s = loop_of(resolved), resolved.timing.controller_period_ns / NS_PER_S
    return resolved.controller.law(ControlModel(loop.A_model, loop.B_model, loop.K, period_s))


def controller_of(resolved: Scenario, start: Start = BEGINNING) -> Controller:
    """Return the controller of a resolved scenario; of the plant's data it uses at most x(0)."""
    loop = loop_of(resolved)
    known = resolved.network.initial_sync == "known_state" and not start.is_restart
    safe_input = resolved.controller.safe_input
    return Controller(
        loop.H,
        law_of(resolved),
        inputs=loop.m,
        period_ns=resolved.timing.controller_period_ns,
        phase_ns=resolved.timing.controller_phase_ns,
        horizon_ns=resolved.timing.horizon_ns,
        guarantee=resolved.network.guarantee,
        x0=loop.x0 if known else None,
        acknowledges=resolved.protocol.acknowledges,
        start=start,
        safe_input=None if safe_input is None else np.array(safe_input),
        predictive=resolved.message_sizes.is_predictive,
        predictions=resolved.controller.predictions,
        setpoint=setpoint_of(resolved),
        schedule=None if resolved.protocol.acknowledges else ChangeSchedule(resolved, setpoint_of),
    )
