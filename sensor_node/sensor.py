"""The sensor: runs the model x_s in parallel to the plant and transmits at events (eq:ModSensor).

This file turns a scenario into the core's sensor, whose steps are in native/loop/sensor.c. At a
measurement: propagate x_s → test → send at most one state update. x_s is reset at *every* event,
whether or not the network delivers the update: nothing is acknowledged. In the acknowledgement
baseline, only an acknowledged update resets x_s.

With an observer the trigger tests x̂ in place of x. The observer needs the input that the plant
applied. The sensor does not receive the actuations, and nothing is acknowledged. So the input is
measured at the actuator, and a measurement carries [y; u of every step since the last measurement].
Sensor and actuator are at the plant, the controller is on the other side of the network.
Montestruque and Antsaklis (2003) place their observer likewise. Disturbances that enter after the
actuator are not part of the measured input. At a measurement, x̂ is predicted over the plant's steps
and corrected by y (native/loop/observer.c). If measurements are missing, the inputs of their steps
are unknown, and the first known input is used.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from netem.core.core_library import CData, reals_at
from netem.core.periods import Period
from noack.core.core_library import core, ffi, new_handle, new_structure
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
from noack.observers.observer_settings import EstimationModel, ObserverSettings
from noack.protocol.record_tables import (
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
    SENSOR_SETTING,
    RecordShape,
)
from noack.protocol.roles import Notice
from noack.protocol.wire_format import Flow
from noack.scenario.estimation import assumed_model
from noack.scenario.parameter_changes import ChangeSchedule
from noack.scenario.resolution import loop_of, policy_of, reference_of
from noack.scenario.scenario import Scenario
from noack.trigger_policies.trigger_rule import CodedPolicy, EventTrigger, Policy, TriggerRule, new_rule

SENSOR = Role(
    "sensor",
    Flow.MEASUREMENT,
    (None, SENSOR_MEASUREMENT, SENSOR_ACKNOWLEDGEMENT),
    SENSOR_SETTING,
)
_ANY_TIME_NS = 2**60
"""The latest horizon of a machine."""


@dataclass
class Observer:
    """The observer of one loop's sensor.

    Args:
        settings: the kind of observer.
        model: the model with the covariances that it assumes.
        x: x̂ before the first measurement, (n,).
        reported: entries of a measurement that are inputs.
        period: the plant's step.
        starts_from_x0: True: x̂ is the estimate at time 0; False: at the first measurement.
    """

    settings: ObserverSettings
    model: EstimationModel
    x: Vector
    reported: int
    period: Period
    starts_from_x0: bool

    @property
    def p(self) -> int:
        """Number of measured outputs."""
        return len(self.model.C)

    def new(self) -> CData:
        """Return a new ``noack_observer``."""
        numbers = {"x": self.x, "t_ns": 0 if self.starts_from_x0 else -1, "reported": self.reported}
        return self.settings.observer(self.model, numbers)


@dataclass
class Sensor(MachinePart):
    """The sensor of one loop.

    Its time is the time of the measurements: its output depends on the measured values and their
    times, not on when a datagram was read.

    Args:
        H: the matrix that the model integrates between updates, shape (n, n), per second.
        policy: the event-triggering policy.
        x0: x(0), if sensor and controller start from it; else None, and the first measurement is an
            event. With acknowledgements x_s is then 0, as x_c is, until an update is acknowledged.
        inputs: m.
        period: expected time between measurements, for precomputed matrices; others are
            possible.
        reference: x_r; None is 0.
        schedule: the announced changes of its settings; None if they cannot change.
        timeout_ns: how long to wait for an acknowledgement; None: updates are not acknowledged.
        observer: estimates x from the measurements; None: they are x.
        reports_error: whether the network chooses by the errors of updates, which then report them.
        horizon_ns: a measurement with a later time is rejected.
    """

    H: Matrix
    policy: Policy
    x0: Vector | None = None
    inputs: int = 1
    period: Period | None = None
    reference: Reference | None = None
    schedule: ChangeSchedule[tuple[Reference | None, Policy]] | None = None
    timeout_ns: int | None = None
    observer: Observer | None = None
    reports_error: bool = False
    horizon_ns: int = _ANY_TIME_NS

    role = SENSOR

    def __post_init__(self) -> None:
        self._trigger: EventTrigger | None = None
        if isinstance(self.policy, CodedPolicy):
            self._trigger = self.policy.new_trigger()
        self._in_force = ReferenceInForce(self.reference, len(self.H), self.inputs)
        self._policy = self.policy
        self._handles: list[CData] = []
        if self._trigger is not None and self.x0 is not None:
            self._trigger.start(0, self._from_reference(0, self.x0))

    @property
    def shape(self) -> RecordShape:
        """The sizes of the rows."""
        outputs, inputs_reported = (
            (0, 0) if self.observer is None else (self.observer.p, self.observer.reported)
        )
        return RecordShape(
            len(self.H),
            self.inputs,
            acknowledged=self.timeout_ns is not None,
            outputs=outputs,
            inputs_reported=inputs_reported,
        )

    def settings(self, models: TransitionMatrices) -> Mapping[str, object]:
        """Return the fields of a ``noack_sensor``."""
        steps_ns = () if self.period is None else self.period.lengths_ns
        settings: dict[str, object] = {
            "machine": {"n": len(self.H), "m": self.inputs, "horizon_ns": self.horizon_ns},
            "model": {
                "transitions": models.of(self.H, steps_ns),
                "reference": self._in_force.reference.core,
            },
            "rule": self._rule(self.policy), "is_user": self._trigger is not None,
            "acknowledged": self.timeout_ns is not None, "timeout_ns": self.timeout_ns or 0,
            "reports_error": self.reports_error,
        }  # fmt: skip
        return settings if self.observer is None else settings | {"plant_period": self.observer.period.core}

    def drawn_settings(self) -> Mapping[str, object]:
        """Return what x(0) determines."""
        start = {"x_s": self.x0, "has_state": self.x0 is not None}
        return start if self.observer is None else start | {"observer": self._kept(self.observer.new())}

    def _rule(self, policy: Policy) -> CData:
        """Return the ``noack_trigger_rule`` of a policy; of code, its norm only."""
        if isinstance(policy, CodedPolicy):
            numbers = {"n": len(self.H), "weight": policy.weight}
            return self._kept(new_handle("trigger_rule", new_structure("noack_trigger_rule", numbers)))
        return self._kept(new_rule(policy, len(self.H)))

    def _kept(self, handle: CData) -> CData:
        """Keep a handle as long as this part, since sensors of the core may use it; return it."""
        self._handles.append(handle)
        return handle

    def answer(self, question: int, sensor: CData) -> Sequence[Notice]:
        """Apply changes, or let the user's trigger decide."""
        if question == core.NOACK_ASK_CHANGE:
            for due in take_changes(self.schedule, sensor.machine):
                assert due.prepared is not None
                reference, policy = due.prepared
                if self._in_force.change(due.since_ns, reference):
                    sensor.model.reference = self._in_force.reference.core
                if isinstance(policy, TriggerRule) and isinstance(self._policy, TriggerRule):
                    policy = policy.continuing(self._policy, due.since_ns)
                self._set_policy(sensor, policy)
        elif question == core.NOACK_ASK_RESTART:
            assert self._trigger is not None
            n = sensor.machine.n
            self._trigger.restart(sensor.trigger.event_ns, reals_at(sensor.event_x, n).copy())
        else:
            assert question == core.NOACK_ASK_DECISION
            self._decide(sensor)
        return ()

    def _set_policy(self, sensor: CData, policy: Policy) -> None:
        """Set a policy as if it had been set at the last event."""
        self._policy, sensor.rule = policy, self._rule(policy)
        event_ns = sensor.trigger.event_ns
        if self._trigger is None and event_ns >= 0:
            state = ffi.addressof(sensor.trigger)
            core.noack_trigger_condition(sensor.rule, state, event_ns, sensor.event_x)

    def _decide(self, sensor: CData) -> None:
        """Ask the user's trigger about a measurement."""
        trigger, n = self._trigger, sensor.machine.n
        assert trigger is not None
        t_ns, e_s = sensor.asked_ns, reals_at(sensor.e_s, n).copy()
        x = self._from_reference(t_ns, reals_at(sensor.x, n).copy())
        if sensor.first:
            trigger.start(t_ns, x)
        decision = trigger.test(t_ns, x, e_s)
        if (decision.event or sensor.first) and not sensor.acknowledged:
            trigger.start(t_ns, x)
        sensor.event, sensor.left, sensor.right = decision

    def _from_reference(self, t_ns: int, x: Vector) -> Vector:
        """Return x − x_r at a time, (n,), which a trigger compares with."""
        return self._in_force.difference(t_ns, x)


def sensors_of(loops: Sequence[Scenario], phases_ns: Sequence[int] | None = None) -> LoopMachines:
    """Return the sensors of resolved loops as the machines of a process.

    Of the plant's data they use at most x(0).
    """
    parts, templates = parts_of(loops, _part, _with_draws_of)
    return LoopMachines(parts, phases_ns, templates=templates)


def _part(resolved: Scenario) -> Sensor:
    loop, acknowledges = loop_of(resolved), resolved.protocol.acknowledges
    starts_from_x0 = resolved.network.initial_sync == "known_state"
    return Sensor(
        loop.H,
        policy_of(resolved),
        loop.known_x0 if starts_from_x0 else None,
        inputs=loop.m,
        period=resolved.timing.measurement_period,
        reference=None if acknowledges else loop.reference,
        schedule=None if acknowledges else ChangeSchedule(resolved, _prepared),
        timeout_ns=resolved.timing.acknowledgement_timeout_ns if acknowledges else None,
        observer=observer_of(resolved),
        reports_error=resolved.network.link.reads_errors,
        horizon_ns=resolved.timing.horizon_ns,
    )


def _with_draws_of(sensor: Sensor, resolved: Scenario) -> Sensor:
    """Return a sensor with the draws of a loop that is alike otherwise."""
    schedule, observer = sensor.schedule, sensor.observer
    return replace(
        sensor,
        x0=None if sensor.x0 is None else loop_of(resolved).known_x0,
        schedule=None if schedule is None else schedule.for_similar_loop(resolved),
        observer=None if observer is None else observer_of(resolved),
    )


def _prepared(resolved: Scenario) -> tuple[Reference | None, Policy]:
    """Return the parts of another scenario that a sensor needs: its reference and its policy."""
    return reference_of(resolved), policy_of(resolved)


def observer_of(resolved: Scenario) -> Observer | None:
    """Return the observer of a resolved scenario; None if it has none."""
    settings, loop = resolved.observer, loop_of(resolved)
    if settings is None:
        return None
    starts_from_x0 = resolved.network.initial_sync == "known_state"
    x = loop.known_x0 if starts_from_x0 else np.zeros(loop.n)
    if settings.initial_estimate is not None:
        x = np.array(settings.initial_estimate)
    return Observer(
        settings,
        assumed_model(resolved),
        x,
        resolved.message_sizes.inputs_reported,
        resolved.timing.plant_period,
        starts_from_x0,
    )
