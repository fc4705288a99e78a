"""Random machines with every kind of setting: the same numbers make the same machine."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st

from controller_node.controller import Controller
from netem.core.clock import NEVER_NS
from netem.core.periods import Period
from netem.guarantee.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
)
from noack.controllers.controller_settings import ControlFailedError
from noack.controllers.linear_feedback import LinearFeedback
from noack.core.core_library import ffi, new_handle
from noack.core.linear_systems import Matrix, Vector, norm, product
from noack.core.references import Reference, ReferenceSegment
from noack.machines.loop_machines import LoopMachines
from noack.observers.kalman import KalmanSettings
from noack.observers.luenberger import LuenbergerSettings
from noack.observers.observer_settings import EstimationModel
from noack.plants.linear import LinearSystem
from noack.plants.plant_settings import SystemFailedError
from noack.protocol.roles import Notice, Output
from noack.protocol.wire_format import Flow, Message
from noack.trigger_policies.trigger_rule import CodedPolicy, Policy, TriggerDecision
from plant_server.plant import Disturbance, MeasurementModel, Plant, Watchdog
from sensor_node.sensor import Observer, Sensor
from tests.helpers.example_rules import TABLES, random_rule
from tests.helpers.machine_parts import OneLoop, SteppedMachines
from tests.helpers.wire_decoder import NO_VECTOR

MS = 1_000_000
Rng = np.random.Generator


class Sizes(NamedTuple):
    """What the machines of a process have in common: the columns of their rows."""

    n: int
    m: int
    outputs: int = 0
    """0: no observer."""
    measure_every: int = 1
    predictions: int = 1
    carries_model: bool = False
    acknowledged: bool = False
    internal: int = 0
    """Above 0: the user's system."""
    disturbed: tuple[bool, bool] = (False, False)


@st.composite
def sizes(draw: st.DrawFn, most: int = 4) -> Sizes:
    n, m = draw(st.integers(1, most)), draw(st.integers(1, most))
    carries_model = draw(st.booleans()) and n + m <= 64
    outputs = draw(st.integers(0, min(n, 64 - m)))
    return Sizes(
        n,
        m,
        outputs=outputs,
        measure_every=draw(st.integers(1, min((64 - outputs) // m, 3))),
        predictions=draw(st.integers(1, min((64 - n * carries_model) // m, 3))),
        carries_model=carries_model,
        acknowledged=draw(st.booleans()),
        internal=draw(st.integers(0, 3)),
        disturbed=draw(st.tuples(st.booleans(), st.booleans())),
    )


def chance(rng: Rng) -> bool:
    return bool(rng.random() < 0.5)


def policies(rng: Rng, n: int) -> list[Policy]:
    """A policy of each form."""
    W = np.eye(n) + 0.1 * rng.normal(size=(n, n)) if chance(rng) else None
    small = float(rng.choice([1e-6, 0.02, 0.5]))
    rules = [random_rule(name, rng, n, W) for name in TABLES]
    return [*rules, CodedPolicy(W, lambda: UserTrigger(small), "it is code")]


@dataclass
class UserTrigger:
    """A user's trigger: the policy ``absolute``, in Python."""

    delta: float
    calls: list[str] = field(default_factory=list)

    def start(self, t_ns: int, x: Vector) -> None:
        self.calls.append("start")

    def restart(self, t_ns: int, x: Vector) -> None:
        self.calls.append("restart")

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> TriggerDecision:
        self.calls.append("test")
        left = norm(e_s)
        return TriggerDecision(left > self.delta, left, self.delta)


class UserSystem:
    """A user's system with a state of its own; it may fail at a time."""

    def __init__(self, A: Matrix, B: Matrix, x: Vector, z: Vector, fails_ns: int) -> None:
        self.A, self.B, self.x, self.z, self._fails_ns = A, B, x, z, fails_ns

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        if t_ns >= self._fails_ns:
            raise SystemFailedError("the system fails")
        self.x = product(self.A, self.x) + product(self.B, u[: self.B.shape[1]])
        self.z = self.z + 1.0


@dataclass
class UserLaw:
    """A user's law; it may fail."""

    K: Matrix
    fails_s: float = np.inf

    def update(self, t_s: float, x: Vector) -> None:
        if t_s > self.fails_s:
            raise ControlFailedError("the law fails")

    def input(self, t_s: float, x_c: Vector, setpoint: tuple[Vector, Vector] | None) -> Vector:
        self.update(t_s, x_c)
        return LinearFeedback(self.K).input(t_s, x_c, setpoint)


def matrix(rng: Rng, scale: float, *shape: int) -> Matrix:
    return np.asarray(scale * rng.uniform(-1, 1, shape))


def reference(rng: Rng, scale: float, n: int, m: int) -> Reference:
    """A set-point, or segments with and without waves."""
    if chance(rng):
        return Reference.constant(matrix(rng, scale, n), matrix(rng, scale, m))
    begins_ns = [0, *sorted((rng.integers(1, 100, 2) * MS).tolist())]
    segments = [
        ReferenceSegment(
            begin_ns,
            matrix(rng, scale, int(rng.integers(1, 4)), n + m),
            rng.uniform(0.1, 20, waves),
            matrix(rng, scale, waves, n + m),
            matrix(rng, scale, waves, n + m),
        )
        for begin_ns, waves in zip(begins_ns, rng.integers(0, 3, 3).tolist(), strict=True)
    ]
    return Reference(segments, n)


def plant(seed: int, of: Sizes, scale: float = 1.0, period_ns: int = 10 * MS) -> Plant:
    """A plant; ``scale`` is that of its matrices and its state."""
    rng = np.random.default_rng(seed)
    n, m, (d, w) = of.n, of.m, of.disturbed
    A, B, x0 = matrix(rng, scale, n, n), matrix(rng, scale, n, m + n * w), matrix(rng, scale, n)
    if of.internal:
        fails_ns = int(rng.choice([300 * MS, NEVER_NS]))
        system: Any = UserSystem(A, B[:, :m], x0, np.zeros(of.internal), fails_ns)
    else:
        system = LinearSystem(A, B, x0)
    waves = [_waves(rng, m)] * d, [_waves(rng, n)] * w
    outputs = of.outputs or n
    C = None if outputs == n and chance(rng) else matrix(rng, 1.0, outputs, n)
    if of.carries_model:
        watchdog = Watchdog(
            timeout_ns=int(rng.choice([30 * MS, NEVER_NS])),
            policy="model",
            notice_ns=35 * MS,
            H=matrix(rng, scale, n, n) * chance(rng),
            K=matrix(rng, scale, m, n),
        )
    else:
        watchdog = Watchdog(
            timeout_ns=int(rng.choice([0, 30 * MS])),
            policy=str(rng.choice(["hold", "zero"])),
            notice_ns=35 * MS,
        )
    return Plant(
        system,
        m,
        period=Period(period_ns),
        horizon_ns=10**12,
        watchdog=watchdog,
        measure_every=of.measure_every,
        predictions=of.predictions,
        input_period=Period(int(rng.integers(1, 20)) * MS),
        disturbance=Disturbance(*waves, widths=(m * d, n * w)) if d or w else None,
        measurement=MeasurementModel(C, *(chance(rng) * np.ones((2, outputs))), seed=seed),
        reports_inputs=of.outputs > 0,
    )


def _waves(rng: Rng, width: int) -> Callable[[range], Matrix]:
    hz = rng.uniform(0, 1, width)
    return lambda steps: np.sin(np.outer(steps, hz))


def sensor(seed: int, of: Sizes, form: int, scale: float = 1.0) -> Sensor:
    """A sensor with a policy of the form of this number."""
    rng = np.random.default_rng(seed)
    n, m, steps = of.n, of.m, of.measure_every
    every = policies(rng, n)
    H = matrix(rng, scale, n, n) * chance(rng)
    return Sensor(
        H,
        every[form % len(every)],
        x0=matrix(rng, scale, n) if chance(rng) else None,
        inputs=m,
        period=Period(10 * MS),
        reference=reference(rng, scale, n, of.m) if chance(rng) else None,
        timeout_ns=int(rng.integers(0, 50)) * MS if of.acknowledged else None,
        observer=observer(rng, of.outputs, n, m, steps, scale) if of.outputs else None,
    )


def observer(rng: Rng, p: int, n: int, m: int, steps: int, scale: float) -> Observer:
    C, Ad, Bd = matrix(rng, 1.0, p, n), 0.5 * matrix(rng, scale, n, n), matrix(rng, scale, n, m)
    model = EstimationModel(
        Ad=Ad, Bd=Bd, Gd=np.eye(n), C=C, Q=0.1 * np.eye(n), R=0.2 * np.eye(p), steps=steps
    )
    rows = tuple(tuple(row) for row in matrix(rng, scale, n, p).tolist())
    if chance(rng):
        settings: Any = KalmanSettings(kind="kalman", initial_std=(0.5,) * n)
    else:
        settings = LuenbergerSettings(kind="luenberger", gain=rows)
    return Observer(
        settings,
        model,
        x=matrix(rng, scale, n),
        reported=steps * m,
        period=Period(10 * MS),
        starts_from_x0=chance(rng),
    )


def controller(
    seed: int, of: Sizes, scale: float = 1.0, period_ns: int = 10 * MS, first_ns: int | None = None
) -> Controller:
    rng = np.random.default_rng(seed)
    n, m = of.n, of.m
    K = matrix(rng, scale, m, n)
    laws = [LinearFeedback(K), UserLaw(K), UserLaw(K, float(rng.uniform(0, 0.3)))]
    constraints = [LossesInWindow(1, 3), DeliveriesBetweenBursts(2)]
    chosen = [LongestBurst(int(rng.integers(0, 3))), *constraints[: rng.integers(0, 3)]]
    point = reference(rng, scale, n, m) if chance(rng) else None
    return Controller(
        matrix(rng, scale, n, n) * chance(rng),
        laws[rng.integers(0, 3)],
        m,
        period=Period(period_ns),
        first_ns=int(rng.integers(0, 10)) * MS if first_ns is None else first_ns,
        horizon_ns=10**12,
        guarantee=LossGuarantee(tuple(chosen)),
        x0=matrix(rng, scale, n) if chance(rng) else None,
        acknowledges=of.acknowledged,
        safe_input=matrix(rng, scale, m),
        carries_model=of.carries_model,
        predictions=of.predictions,
        timeout_ns=int(rng.integers(1, 60)) * MS if chance(rng) else NEVER_NS,
        holds_input=chance(rng),
        reference=point,
    )


class Inputs:
    """Random inputs of machines: ticks in time or late, and messages after losses.

    Args:
        machines: the machines.
        seed: of the choices.
        values: what entries of vectors are drawn from; by default from (-1, 1).
    """

    def __init__(self, machines: LoopMachines, seed: int, values: Sequence[float] = ()) -> None:
        self._machines, self._rng, self._values = machines, np.random.default_rng(seed), values
        self._now_ns = max(machines.phases_ns)
        self._numbers: dict[tuple[int, Flow], int] = {}
        self._measured_ns = [0] * len(machines.parts)
        self.sent: list[list[Message]] = [[] for _ in machines.parts]
        """What each loop's machine has sent; :func:`driven` adds to it."""

    def next(self) -> tuple[Message | None, int]:
        """Return a message, or None for the next tick, and the time of its arrival."""
        due_ns = self._machines.next_deadline_ns()
        if due_ns is not None and chance(self._rng):
            late_ns = int(self._rng.choice([0, 0, 1, 25 * MS]))
            self._now_ns = max(self._now_ns, due_ns + late_ns)
            return None, self._now_ns
        self._now_ns += int(self._rng.integers(0, 15)) * MS
        return self._message(int(self._rng.integers(len(self._machines.parts)))), self._now_ns

    def _message(self, loop: int) -> Message:
        own, part = self._machines, self._machines.parts[loop]
        own_ns = self._now_ns - own.phases_ns[loop]
        if part.shape.acknowledged and self.sent[loop] and chance(self._rng):
            update = self.sent[loop][self._rng.integers(-3, 0) % len(self.sent[loop])]
            number = update.sequence + int(self._rng.choice([0, 0, 1000]))
            return Message(Flow.ACKNOWLEDGEMENT, number, update.t_ns, NO_VECTOR, loop)
        if own.role.receives is Flow.MEASUREMENT:
            self._measured_ns[loop] += int(self._rng.choice([1, 1, 2, 7])) * 10 * MS
            own_ns = self._measured_ns[loop]
        else:
            own_ns = max(own_ns - int(self._rng.integers(-30, 40)) * MS, 0)
        number = self._numbers.get((loop, own.role.receives), -1)
        number += int(self._rng.choice([1, 1, 1, 2, 4]))
        self._numbers[loop, own.role.receives] = number
        entries = own.machines[loop].machine.received.entries
        vector = self._rng.uniform(-1, 1, entries)
        if self._values:
            vector = self._rng.choice(self._values, entries)
        return Message(own.role.receives, number, own_ns, vector, loop)


def driven(
    machines: SteppedMachines, inputs: Inputs, count: int
) -> Iterator[tuple[int, Message | None, int, list[Any]]]:
    """Give machines inputs; yield the loop, the input, its time and the plain outputs of each."""
    for _ in range(count):
        message, now_ns = inputs.next()
        if message is None:
            loop = int(machines.core.heap[0].number)
            outputs = machines.on_timer(now_ns)
        else:
            loop, outputs = message.loop, machines.handle(message, now_ns)
        sent = [message for message in outputs if isinstance(message, Message)]
        assert {message.loop for message in sent} <= {loop}
        inputs.sent[loop] += sent
        yield loop, message, now_ns, plain(outputs, numbered=not isinstance(machines, OneLoop))


def plain(outputs: Sequence[Output], *, numbered: bool) -> list[Any]:
    """Outputs to compare bit for bit, without the number of their loop."""
    return [_plain(output, numbered) for output in outputs]


def _plain(output: Output, numbered: bool) -> Any:
    if isinstance(output, Notice):
        return output._replace(loop=None)
    if isinstance(output, Message):
        return output.flow, output.sequence, output.t_ns, output.vector.tobytes()
    row = output.row[numbered:]
    return output.table, [np.asarray(entry).tobytes() for entry in row]


def with_number(part: Plant | Sensor | Controller, path: str, value: Any) -> Any:
    """Give a machine another number than its settings have, also one of a rule or reference in it.

    Raises:
        ValueError: the core refuses the number there.
    """
    name, *way = re.findall(r"\w+", path)
    settings, drawn_settings = part.settings, part.drawn_settings

    def changed(given: Mapping[str, Any]) -> Mapping[str, Any]:
        given = dict(given)
        if name not in given:
            return given
        given[name] = _with_number(given[name], way, value)
        part.kept = given[name]  # type: ignore[union-attr]
        return given

    part.settings = lambda models: changed(settings(models))  # type: ignore[method-assign]
    part.drawn_settings = lambda: changed(drawn_settings())  # type: ignore[method-assign]
    return part


def _with_number(owner: Any, way: Sequence[str], value: Any) -> Any:
    """Return what has another number at the end of a way, as far as it is a handle a new one."""
    if not way:
        return value
    name, *rest = way
    if isinstance(owner, Mapping):
        return {**owner, name: _with_number(owner.get(name), rest, value)}
    pointer = owner
    for inner in way[:-1]:
        pointer = getattr(pointer, inner)
    if way[-1].isdigit():
        pointer[int(way[-1])] = value
    else:
        setattr(pointer, way[-1], value)
    kind = ffi.typeof(owner).item.cname
    return new_handle(kind.removeprefix("noack_"), owner)


def refusal_of(part: Any) -> str | None:
    """What the core refuses of a machine; None if nothing."""
    try:
        LoopMachines([part])
    except ValueError as error:
        return str(error)
    return None
