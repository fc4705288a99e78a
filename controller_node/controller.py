"""The controller: runs the model x_c, which only a delivered update resets (eq:ModCont).

This file turns a scenario into the core's controller. native/loop/controller.c has its steps, and
explains them. :class:`LossCheck` compares the losses that the recorded rows show with the network's
guarantee.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from netem.core.clock import NEVER_NS, NS_PER_S
from netem.core.core_library import CData, reals_at
from netem.core.periods import Period
from netem.guarantee.loss_guarantee import LongestBurst, LossGuarantee, LossHistory, LossRule
from noack.controllers.controller_settings import ControlFailedError, ControlLaw, ControlModel
from noack.controllers.linear_feedback import LinearFeedback
from noack.core.core_library import core
from noack.core.linear_systems import Matrix, Vector
from noack.core.references import Reference, ReferenceInForce
from noack.machines.loop_machines import (
    LoopMachines,
    MachinePart,
    Role,
    TransitionMatrices,
    parts_of,
    take_changes,
)
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_SETTING, CONTROLLER_STEP, RecordShape
from noack.protocol.roles import FAILED, External, Notice
from noack.protocol.wire_format import Flow
from noack.scenario.parameter_changes import ChangeSchedule
from noack.scenario.resolution import loop_of, reference_of
from noack.scenario.scenario import Scenario

CONTROLLER = Role(
    "controller",
    Flow.UPDATE,
    (CONTROLLER_STEP, CONTROLLER_DELIVERY, None),
    CONTROLLER_SETTING,
)


class LossCheck:
    """Compares the losses of received updates with the guarantee that was in force when they occurred.

    After a change of the guarantee, the rules other than the limit of consecutive losses begin
    anew, with the first update after one that was sent under the new guarantee.

    Args:
        guarantee: more losses violate the assumption.
        schedule: the announced changes of settings; None if there are none.
        known_start: whether the controller needs no first update.
    """

    def __init__(
        self,
        guarantee: LossGuarantee,
        schedule: ChangeSchedule[object] | None,
        *,
        known_start: bool,
    ) -> None:
        self._schedule = schedule
        self._known_start = known_start
        self._guarantee = guarantee
        self._since_ns = 0
        self._further_rules = _further_rules_of(guarantee)
        self._history = LossHistory(self._further_rules)
        self._newest_ns = 0

    def reach(self, t_ns: int) -> None:
        """Use the guarantee that is in force at a time of the controller's model."""
        if self._schedule is not None:
            applied = self._schedule.at(t_ns)
            self._change(applied.scenario.network.guarantee, applied.since_ns)

    @property
    def counts_every_update(self) -> bool:
        """Whether updates without a loss before them matter, too."""
        return bool(self._further_rules) or (self._schedule is not None and self._schedule.has_changes)

    def _change(self, guarantee: LossGuarantee, since_ns: int) -> None:
        """Use another guarantee for what is sent from ``since_ns`` on."""
        if guarantee != self._guarantee:
            self._guarantee, self._since_ns = guarantee, since_ns
            self._further_rules = _further_rules_of(guarantee)
            self._history = LossHistory(self._further_rules)

    def add(self, sequence: int, newest: int, losses: int, event_ns: int, now_ns: int) -> Sequence[Notice]:
        """Add an update that follows ``losses`` losses; return the violations.

        ``newest`` is the number of the update before; −1 if there is none.
        """
        newest_ns, self._newest_ns = self._newest_ns, event_ns
        violation = self._check_burst(sequence, losses, newest_ns, max(now_ns, event_ns))
        if not violation and newest == -1 and losses > 0 and not self._known_start:
            lost = "1 update was lost" if losses == 1 else f"{losses} updates were lost"
            violation = f"no delivered t_0: {lost} before the first delivery"
        texts = [violation] if violation else []
        if newest_ns >= self._since_ns:
            texts += self._check_further_rules(sequence, losses)
        return [Notice(event_ns, "violation", text) for text in texts]

    def _check_burst(self, sequence: int, losses: int, newest_ns: int, now_ns: int) -> str:
        """Return the violation of the largest limit since the update before; else an empty text."""
        allowed = _longest_burst(self._guarantee)
        if losses > allowed and self._schedule is not None:
            scenarios = self._schedule.between(newest_ns, now_ns)
            allowed = max(_longest_burst(scenario.network.guarantee) for scenario in scenarios)
        if losses <= allowed:
            return ""
        lost = "1 loss" if losses == 1 else f"{losses} consecutive losses"
        return f"MANSD violated: {lost} before update {sequence}, at most {allowed} assumed"

    def _check_further_rules(self, sequence: int, losses: int) -> list[str]:
        """Return the largest violation of each further rule."""
        if not self._further_rules:
            return []
        worst: dict[LossRule, int] = {}
        # After a whole window of losses, one more changes nothing.
        for lost in (True,) * min(losses, self._longest_window) + (False,):
            for rule, value in self._history.add(lost):
                if lost:
                    worst[rule] = max(worst.get(rule, 0), value)
        return [
            f"{rule.name} violated: {rule.violation(value)}, before update {sequence}"
            for rule, value in worst.items()
        ]

    @property
    def _longest_window(self) -> int:
        return max(window.packets for window in self._guarantee.windows)


def _further_rules_of(guarantee: LossGuarantee) -> tuple[LossRule, ...]:
    return tuple(rule for rule in guarantee.rules if not isinstance(rule, LongestBurst))


def _longest_burst(guarantee: LossGuarantee) -> int:
    """The limit of consecutive losses that is set, not what follows from other rules."""
    return min(rule.limit for rule in guarantee.rules if isinstance(rule, LongestBurst))


@dataclass
class Controller(MachinePart):
    """The controller of one loop.

    Args:
        H: what the model integrates between updates, shape (n, n), per second.
        law: the control law.
        inputs: m.
        period: time between two control inputs.
        first_ns: time of the first.
        horizon_ns: no tick is due after this time.
        guarantee: losses that it does not allow violate the assumption.
        x0: x(0), if sensor and controller start from it; else None.
        acknowledges: whether it acknowledges each update, as the acknowledgement baseline does.
        safe_input: the input before the first update, shape (m,); by default 0.
        carries_model: whether an actuation also carries x_c, for the plant's watchdog.
        predictions: number of inputs of an actuation: that of the tick, and those for the
            following ticks if no update arrives until then; only with a linear law.
        timeout_ns: age from which on the newest update is too old; only with a linear law.
        holds_input: whether the last input is then held; else the input is the safe input.
        reference: u = K(x_c − x_r) + u_r; None is 0.
        schedule: the announced changes of its settings; None if they cannot change.
    """

    H: Matrix
    law: ControlLaw
    inputs: int
    period: Period
    first_ns: int
    horizon_ns: int
    guarantee: LossGuarantee
    x0: Vector | None = None
    acknowledges: bool = False
    safe_input: Vector | None = None
    carries_model: bool = False
    predictions: int = 1
    timeout_ns: int = NEVER_NS
    holds_input: bool = False
    reference: Reference | None = None
    schedule: ChangeSchedule[Reference | None] | None = None

    role = CONTROLLER

    def __post_init__(self) -> None:
        self._losses = LossCheck(self.guarantee, self.schedule, known_start=self.x0 is not None)
        self._in_force = ReferenceInForce(self.reference, len(self.H), self.inputs)
        self._failed = False

    @property
    def counts_every_message(self) -> bool:
        """Whether updates without a loss before them matter, too."""
        return self._losses.counts_every_update

    @property
    def shape(self) -> RecordShape:
        """The sizes of the rows."""
        return RecordShape(len(self.H), self.inputs)

    @property
    def external(self) -> External | None:
        """The law, if another program has it."""
        return self.law if isinstance(self.law, External) else None

    def settings(self, models: TransitionMatrices) -> Mapping[str, object]:
        """Return the fields of a ``noack_controller``."""
        period, first_ns = self.period, self.first_ns
        rests_ns = (length_ns - first_ns for length_ns in period.lengths_ns)
        machine = {
            "n": len(self.H), "m": self.inputs, "period": period.core, "first_ns": first_ns,
            "horizon_ns": self.horizon_ns,
        }  # fmt: skip
        K = self.law.K if isinstance(self.law, LinearFeedback) else None
        return {
            "machine": machine,
            "model": {
                "transitions": models.of(self.H, (*period.lengths_ns, first_ns, *rests_ns)),
                "reference": self._in_force.reference.core,
            },
            "K": K, "is_user": K is None, "safe_input": self.safe_input,
            "acknowledges": self.acknowledges, "predictions": self.predictions,
            "carries_model": self.carries_model, "timeout_ns": self.timeout_ns,
            "holds_input": self.holds_input,
        }  # fmt: skip

    def drawn_settings(self) -> Mapping[str, object]:
        """Return what x(0) determines."""
        return {"x_c": self.x0, "has_state": self.x0 is not None}

    def answer(self, question: int, controller: CData) -> Sequence[Notice]:
        """Apply changes, or call the user's control law."""
        n, t_ns = controller.machine.n, controller.asked_ns
        if question == core.NOACK_ASK_CHANGE:
            for due in take_changes(self.schedule, controller.machine):
                if self._in_force.change(due.since_ns, due.prepared):
                    controller.model.reference = self._in_force.reference.core
            return ()
        x, t_s = reals_at(controller.x, n).copy(), t_ns / NS_PER_S
        if question == core.NOACK_ASK_UPDATE:
            return self._call(controller, lambda law: law.update(t_s, x))
        assert question == core.NOACK_ASK_INPUT
        x_r_and_u_r = self._in_force.point(max(t_ns, controller.model_ns))
        return self._call(controller, lambda law: law.input(t_s, x, x_r_and_u_r))

    def inspect(self, rows: NDArray[np.void]) -> Sequence[Notice]:
        """Compare the losses before received updates with the guarantee; return the violations."""
        notices: list[Notice] = []
        names = ("sequence", "dropouts", "t_ns", "now_ns", "model_t_ns")
        for sequence, losses, t_ns, now_ns, model_ns in zip(
            *(rows[name].tolist() for name in names), strict=True
        ):
            self._losses.reach(model_ns)
            newest = sequence - losses - 1
            notices += self._losses.add(sequence, newest, losses, t_ns, now_ns)
        return notices

    def _call(self, controller: CData, method: Callable[[ControlLaw], Vector | None]) -> Sequence[Notice]:
        """Call the control law; after its first failure, the input is the safe input."""
        m = controller.machine.m
        safe = np.zeros(m) if self.safe_input is None else self.safe_input
        u, notices = None, list[Notice]()
        if not self._failed:
            try:
                u = method(self.law)
            except ControlFailedError as error:
                self._failed = True
                notices.append(Notice(controller.asked_ns, FAILED, str(error)))
        reals_at(controller.u, m)[:] = safe if u is None else u
        return notices


def controllers_of(loops: Sequence[Scenario], phases_ns: Sequence[int] | None = None) -> LoopMachines:
    """Return the controllers of resolved loops as the machines of a process.

    Of the plant's data they use at most x(0).
    """
    parts, templates = parts_of(loops, _part, _with_draws_of)
    return LoopMachines(parts, phases_ns, templates=templates)


def _with_draws_of(controller: Controller, resolved: Scenario) -> Controller:
    """Return a controller with the draws of a loop that is alike otherwise."""
    law, schedule = controller.law, controller.schedule
    return replace(
        controller,
        law=law if isinstance(law, LinearFeedback) else law_of(resolved),
        x0=None if controller.x0 is None else loop_of(resolved).known_x0,
        schedule=None if schedule is None else schedule.for_similar_loop(resolved),
    )


def _part(resolved: Scenario) -> Controller:
    loop = loop_of(resolved)
    starts_from_x0 = resolved.network.initial_sync == "known_state"
    safe_input, acknowledges = resolved.controller.safe_input, resolved.protocol.acknowledges
    return Controller(
        loop.H,
        law_of(resolved),
        inputs=loop.m,
        period=resolved.timing.controller_period,
        first_ns=resolved.timing.controller_phase_ns,
        horizon_ns=resolved.timing.horizon_ns,
        guarantee=resolved.network.guarantee,
        x0=loop.known_x0 if starts_from_x0 else None,
        acknowledges=acknowledges,
        safe_input=None if safe_input is None else np.array(safe_input),
        carries_model=resolved.message_sizes.carries_model,
        predictions=resolved.controller.predictions,
        timeout_ns=resolved.timing.update_timeout_ns,
        holds_input=resolved.controller.timeout_input == "hold",
        reference=loop.reference,
        schedule=None if acknowledges else ChangeSchedule(resolved, reference_of),
    )


def law_of(resolved: Scenario) -> ControlLaw:
    """Return the control law of a resolved scenario.

    Raises:
        CallerError: the user's class does not exist, raises, or lacks a required method.
    """
    loop, period_s = loop_of(resolved), resolved.timing.controller_period_ns / NS_PER_S
    return resolved.controller.law(ControlModel(loop.A_model, loop.B_model, loop.K, period_s))
