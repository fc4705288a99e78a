"""The plant: a system on a time grid, under held inputs.

This file turns a scenario into the core's plant, whose steps are in native/loop/plant.c: at grid
time t_k = k h the plant advances its system to t_k under the input held since t_{k−1}; then it
measures, and latches the newest actuation received. If the system fails, x is NaN from then on, as
in a plant that diverges, and a notice gives the reason.

The scenario defines the system (``noack.plants``), the disturbance from t_k until t_{k+1}, the
measurement, and the watchdog: the input when no actuation has arrived for too long. At t_k the
newest actuation is too old if t_k − t > timeout. Here t is the time of the model state x_c from
which the actuation was computed; before the first actuation, t = 0. Until then its inputs are
applied. The policy then determines the input:

* ``hold``: the last input of the newest actuation;
* ``zero``: 0;
* ``model``: a predictive actuator. It applies the controller's input for the case that no update
  has arrived since t: u + K(x̂ − x_c) with x̂ = e^{H(t_k − t)} x_c. For this an actuation carries
  [u; x_c]. Since u = K x_c, the input equals K x̂. Before the controller's first update, x_c = 0
  and u is the safe input, so the input is the safe input. With zero-order hold (H = 0) it is u.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from netem.core.clock import NEVER_NS, NS_PER_S
from netem.core.core_library import CData, reals_at
from netem.core.periods import ANY_PERIOD, Period
from netem.core.random_streams import normals, uniforms
from noack.core.core_library import core
from noack.core.linear_systems import Matrix, Vector, discretise, product, transition
from noack.disturbances.disturbance_settings import Place, SignalSource
from noack.machines.loop_machines import LoopMachines, MachinePart, Role, TransitionMatrices, parts_of
from noack.plants.linear import LinearSystem
from noack.plants.plant_settings import PlantStart, PlantSystem, SystemFailedError
from noack.protocol.record_tables import NO_SEQUENCE, PLANT_ACTUATION, PLANT_STEP, RecordShape
from noack.protocol.roles import FAILED, External, Notice
from noack.protocol.wire_format import Flow
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.scenario.sections import PlantSection

PLANT = Role("plant", Flow.ACTUATION, (PLANT_STEP, PLANT_ACTUATION, None))
BLOCK = 256
"""Number of steps computed at once. A random value depends on its step's number only."""
INPUT_NAMES = {"hold": "held", "zero": "0", "model": "the model's"}
"""The input that each policy applies, in words."""
_POLICIES = {
    "hold": core.NOACK_HOLD,
    "zero": core.NOACK_ZERO,
    "model": core.NOACK_PREDICT,
}
DisturbanceSignal = Callable[[range], Matrix]
"""Steps → the value added during each step, (k, entries)."""


class Disturbance:
    """The sum of all disturbances at the input, and of all at the state.

    Args:
        at_input: disturbances of u.
        at_state: disturbances of ẋ.
        widths: their entries, m and n; 0 where there is no disturbance.
    """

    def __init__(
        self, at_input: list[DisturbanceSignal], at_state: list[DisturbanceSignal], widths: tuple[int, int]
    ) -> None:
        self._parts, self.widths = (at_input, at_state), widths

    def values(self, steps: range) -> tuple[Matrix, Matrix]:
        """Return d, shape (k, m), and w, (k, n), of k steps; (k, 0) where there is none."""
        d, w = (_sum(signals, steps) for signals in self._parts)
        return d, w


class MeasurementModel:
    """Measures the state, with noise.

    C has the shape (p, n); None is the identity, with exactly y = x + v. ``std`` is the standard
    deviation of a normally distributed part of v, ``bound`` the bound of a uniform part, (p,) each.
    """

    def __init__(self, C: Matrix | None, std: Vector, bound: Vector, seed: int) -> None:
        self.C = C
        self._std, self._bound, self._seed = std, bound, seed
        self.is_noisy = bool(std.any() or bound.any())

    def noise(self, first: int, count: int = BLOCK) -> Matrix:
        """Return v of the ``count`` measurements from number ``first`` on, (count, p)."""
        rows, width = range(first, first + count), len(self._std)
        name = ("plant", "measurement")
        normal = normals(self._seed, *name, "normal", rows=rows, width=width)
        unit = uniforms(self._seed, *name, "uniform", rows=rows, width=width)
        noise: Matrix = self._std * normal + self._bound * (2.0 * unit - 1.0)
        return noise


@dataclass(frozen=True)
class Watchdog:
    """Settings of a plant's watchdog."""

    timeout_ns: int = NEVER_NS  # The policy chooses the input if the newest actuation is older
    policy: str = "hold"
    notice_ns: int = 0  # Age from which a notice reports it; at least the timeout
    H: Matrix | None = None  # The controller's model, (n, n), of policy ``model``
    K: Matrix | None = None  # Its gain, (m, n)

    @property
    def carries_model(self) -> bool:
        """Whether actuations carry the controller's model state."""
        return self.policy == "model"

    def settings(self, models: TransitionMatrices, period: Period) -> Mapping[str, object]:
        """Return the fields of a ``noack_plant`` with this step."""
        model = None if self.H is None else models.of(self.H, period.lengths_ns)
        return {
            "watchdog": _POLICIES[self.policy], "timeout_ns": self.timeout_ns,
            "notice_ns": max(self.notice_ns, self.timeout_ns), "carries_model": self.carries_model,
            "K": self.K, "fallback": {"transitions": model},
        }  # fmt: skip


def too_old(t_ns: NDArray[np.int64], newest_ns: NDArray[np.int64], timeout_ns: int) -> NDArray[np.bool_]:
    """Whether actuations of the times ``newest_ns`` are too old at ``t_ns``."""
    return t_ns - newest_ns > timeout_ns


def watchdog_notice(watchdog: Watchdog, note: CData) -> Notice:
    """Return the line for the log of a ``noack_note``."""
    t_ns, since_ns, newest_ns = (int(note[name]) for name in ("t_ns", "since_ns", "newest_ns"))
    if since_ns >= 0:
        lasted_s = (t_ns - since_ns) / NS_PER_S
        text = f"actuations arrive again; there was none in time for {lasted_s:.4g} s"
        return Notice(t_ns, "watchdog", text)
    age_s, timeout_s = ((ns / NS_PER_S) for ns in (t_ns - newest_ns, watchdog.timeout_ns))
    has_none = note["newest_sequence"] == NO_SEQUENCE
    what = "no actuation for" if has_none else "the newest actuation is too old:"
    name = INPUT_NAMES[watchdog.policy]
    text = f"{what} {age_s:.4g} s, {timeout_s:.4g} s allowed; the input is {name}"
    return Notice(t_ns, "watchdog", text)


@dataclass
class Plant(MachinePart):
    """The plant of one loop.

    Args:
        system: the system to advance, at x(0).
        inputs: m.
        watchdog: what is applied if the newest actuation is too old.
        period: step h.
        horizon_ns: no step is due after this time.
        measure_every: number of steps per measurement.
        predictions: number of inputs of an actuation.
        input_period: time between them, the period of the controller.
        disturbance: is added to u and to ẋ; None if there is none.
        measurement: the measurement model; None if y = x.
        reports_inputs: whether a measurement also carries the inputs of the steps since the last
            measurement. These are the latched inputs, without the disturbance.
        section: the scenario's table of it, by which loops with the same plant are known.
    """

    system: PlantSystem
    inputs: int
    period: Period
    horizon_ns: int
    watchdog: Watchdog = field(default_factory=Watchdog)
    measure_every: int = 1
    predictions: int = 1
    input_period: Period = ANY_PERIOD
    disturbance: Disturbance | None = None
    measurement: MeasurementModel | None = None
    reports_inputs: bool = False
    section: PlantSection | None = None

    role = PLANT

    @property
    def shape(self) -> RecordShape:
        """The sizes of the rows."""
        d, w = (0, 0) if self.disturbance is None else self.disturbance.widths
        return RecordShape(
            len(self.system.x),
            self.inputs,
            carries_model=self.watchdog.carries_model,
            predictions=self.predictions,
            internal=len(self.system.z),
            disturbed_input=d > 0,
            disturbed_state=w > 0,
        )

    @property
    def external(self) -> External | None:
        """The system, if another program has it."""
        return self.system if isinstance(self.system, External) else None

    def settings(self, models: TransitionMatrices) -> Mapping[str, object]:
        """Return the fields of a ``noack_plant``."""
        machine = {
            "n": len(self.system.x), "m": self.inputs, "period": self.period.core,
            "horizon_ns": self.horizon_ns,
        }  # fmt: skip
        widths = (0, 0) if self.disturbance is None else self.disturbance.widths
        C = None if self.measurement is None else self.measurement.C
        outputs = len(self.system.x) if C is None else len(C)
        noisy = self.measurement is not None and self.measurement.is_noisy
        # No block of disturbances and noise has been drawn yet.
        at_input, at_state, noise = (
            {"width": width, "first": -BLOCK, "rows": BLOCK} for width in (*widths, outputs * noisy)
        )
        linear = isinstance(self.system, LinearSystem)
        return {
            "machine": machine, "internal": self.shape.internal, "C": C, "p": outputs,
            "system": core.NOACK_LINEAR if linear else core.NOACK_USER,
            "measure_every": self.measure_every, "reports_inputs": self.reports_inputs,
            "predictions": self.predictions, "input_period": self.input_period.core,
            "at_input": at_input, "at_state": at_state, "noise": noise,
            **self.watchdog.settings(models, self.period),
        }  # fmt: skip

    def drawn_settings(self) -> Mapping[str, object]:
        """Return the state, and the matrices of a linear system."""
        state: dict[str, object] = {"x": self.system.x, "z": self.system.z}
        if not isinstance(self.system, LinearSystem):
            return state
        A, B = self.system.A, self.system.B
        Ad, Bd = zip(*(discretise(A, B, length_ns) for length_ns in self.period.lengths_ns), strict=True)
        return state | {"Ad": np.array(Ad), "Bd": np.array(Bd)}

    def answer(self, question: int, plant: CData) -> Sequence[Notice]:
        """Compute the disturbances and the noise of the next steps, or advance the system."""
        if question == core.NOACK_ASK_SIGNALS:
            self._set_signals(plant)
            return ()
        assert question == core.NOACK_ASK_STATE
        last_ns, t_ns = map(self.period.time_ns, (plant.machine.step - 1, plant.machine.step))
        x, z = reals_at(plant.x, plant.machine.n), reals_at(plant.z, plant.internal)
        applied = reals_at(plant.applied, plant.sources).copy()
        try:
            self.system.advance(applied, last_ns, t_ns - last_ns)
        except SystemFailedError as error:
            plant.system = core.NOACK_FAILED
            x[:], z[:] = np.nan, np.nan
            return (Notice(t_ns, FAILED, str(error)),)
        x[:], z[:] = self.system.x, self.system.z
        return ()

    def note(self, note: CData) -> Notice:
        """Return the line about actuations that are missing, or arrive again."""
        return watchdog_notice(self.watchdog, note)

    def _set_signals(self, plant: CData) -> None:
        step = plant.machine.step
        first = step - step % BLOCK
        if self.disturbance is not None:
            blocks = self.disturbance.values(range(first, first + BLOCK))
            for signal, values in zip((plant.at_input, plant.at_state), blocks, strict=True):
                if signal.width:
                    signal.first = first
                    reals_at(signal.values, BLOCK, signal.width)[:] = values
        if self.measurement is not None and plant.noise.width:
            number = plant.measurements - plant.measurements % BLOCK
            plant.noise.first = number
            reals_at(plant.noise.values, BLOCK, plant.noise.width)[:] = self.measurement.noise(number)


def plants_of(loops: Sequence[Scenario], phases_ns: Sequence[int] | None = None) -> LoopMachines:
    """Return the plants of resolved loops as the machines of a process."""
    parts, templates = parts_of(loops, _part, _with_draws_of)
    return LoopMachines(parts, phases_ns, templates=templates)


def _part(resolved: Scenario) -> Plant:
    return Plant(
        system_of(resolved),
        resolved.model.dimensions[1],
        period=resolved.timing.plant_period,
        horizon_ns=resolved.timing.horizon_ns,
        watchdog=watchdog_of(resolved),
        measure_every=resolved.plant.measure_every,
        predictions=resolved.controller.predictions,
        input_period=resolved.timing.controller_period,
        disturbance=disturbance_of(resolved),
        measurement=measurement_model_of(resolved),
        reports_inputs=resolved.observer is not None,
        section=resolved.plant,
    )


def _with_draws_of(plant: Plant, resolved: Scenario) -> Plant:
    is_repeated = isinstance(plant.system, LinearSystem) and resolved.plant is plant.section
    if is_repeated and plant.disturbance is None and plant.measurement is None:
        return plant
    return replace(
        plant,
        system=system_of(resolved),
        disturbance=disturbance_of(resolved),
        measurement=measurement_model_of(resolved),
    )


def system_of(resolved: Scenario) -> PlantSystem:
    """Return the system of a resolved scenario's plant, at x(0).

    If the state of a linear plant is disturbed, the disturbance is a further input: ẋ = Ax + [B
    I][u; w].

    Raises:
        CallerError: a file or module that the system needs is missing, or differs from the
            settings.
    """
    plant, model = resolved.plant, resolved.model
    A: Matrix = np.array(model.A if plant.A is None else plant.A)
    B: Matrix = np.array(model.B if plant.B is None else plant.B)
    if any(disturbance.at == "state" for disturbance in plant.disturbances):
        B = np.hstack([B, np.eye(len(A))])
    x0, k = np.array(plant.initial_state), model.load_states
    step_ns = resolved.timing.plant_period_ns
    if not resolved.coverage.is_linear and model.states > model.plant_states:
        n = model.plant_states
        system = plant.system.system(PlantStart(x0[:n], A[:n, :n], B[:n], step_ns))
        return LoadedSystem(system, x0[n:]) if k else ControlledSystem(system, A[n:])
    return plant.system.system(PlantStart(x0, A, B, step_ns))


class LoadedSystem:
    """A plant that is not linear, whose state x goes on with its constant loads d, (n + k,).

    Loads other than 0 are added to the input.
    """

    def __init__(self, system: PlantSystem, load: Vector) -> None:
        self._system, self._load = system, load

    @property
    def x(self) -> Vector:
        """The state and the loads."""
        return np.concatenate([self._system.x, self._load])

    @property
    def z(self) -> Vector:
        """The system's own state."""
        return self._system.z

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Advance the system under u + d."""
        self._system.advance(u + self._load if self._load.any() else u, t_ns, dt_ns)


class ControlledSystem:
    """A plant that is not linear, whose state x goes on with the controller's states ξ, (n + k,).

    dξ/dt = B_c x + A_c ξ, ξ(0) = 0. During a step, x is taken to change linearly.
    """

    def __init__(self, system: PlantSystem, rows: Matrix) -> None:
        """Take ``rows`` = [B_c, A_c], (k, n + k)."""
        self._system, self._rows, self._xi = system, rows, np.zeros(len(rows))

    @property
    def x(self) -> Vector:
        """The plant's state and the controller's."""
        return np.concatenate([self._system.x, self._xi])

    @property
    def z(self) -> Vector:
        """The system's own state."""
        return self._system.z

    def advance(self, u: Vector, t_ns: int, dt_ns: int) -> None:
        """Advance the system under u, and ξ under x."""
        before = self._system.x.copy()
        self._system.advance(u, t_ns, dt_ns)
        slope_per_s = (self._system.x - before) / (dt_ns * 1e-9)
        n, k = len(before), len(self._xi)
        flow = np.zeros((2 * n + k, 2 * n + k))  # of (x, ξ, dx/dt)
        flow[:n, n + k :] = np.eye(n)
        flow[n : n + k, : n + k] = self._rows
        moved = product(transition(flow, dt_ns), np.concatenate([before, self._xi, slope_per_s]))
        self._xi = moved[n : n + k]


def disturbance_of(resolved: Scenario) -> Disturbance | None:
    """Return the disturbances of a resolved scenario's plant; None if it has none."""
    if not resolved.plant.disturbances:
        return None
    signals: dict[Place, list[DisturbanceSignal]] = {"input": [], "state": []}
    for number, disturbance in enumerate(resolved.plant.disturbances):
        name = ("plant", "disturbance", str(number))
        source = SignalSource(resolved.timing.plant_period, resolved.seeds.disturbance, name)
        signals[disturbance.at].append(partial(disturbance.signal, source=source))
    n, m = resolved.model.dimensions
    widths = m * bool(signals["input"]), n * bool(signals["state"])
    return Disturbance(signals["input"], signals["state"], widths)


def _sum(signals: list[DisturbanceSignal], steps: range) -> Matrix:
    if not signals:
        return np.zeros((len(steps), 0))
    return np.asarray(sum(signal(steps) for signal in signals))


def measurement_model_of(resolved: Scenario) -> MeasurementModel | None:
    """Return the measurement model of a resolved scenario; None if y is exactly x."""
    settings, n = resolved.plant.measurement, resolved.model.dimensions[0]
    if settings.selects_all(n) and not settings.is_noisy:
        return None
    C = None if settings.selects_all(n) else np.array(settings.C)
    return MeasurementModel(C, *settings.noise(n), resolved.seeds.noise)


def watchdog_of(resolved: Scenario) -> Watchdog:
    """Return the watchdog of a resolved scenario's plant."""
    timing, policy, loop = resolved.timing, resolved.plant.watchdog.policy, loop_of(resolved)
    model = (loop.H, loop.K) if policy == "model" else ()
    return Watchdog(timing.actuation_timeout_ns, policy, timing.missing_actuation_ns, *model)
