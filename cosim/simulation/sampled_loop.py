"""Many runs of a scenario's loop as its processes run it, from event to event.

The machines of the loop make the steps of all runs (native/driver/segments.c): at step k of the
plant, in this order, x advances under the input held since step k − 1, and the newest actuation is
latched. If k is a multiple of ``steps_per_measurement``, y is measured (with an observer y = x̂),
and the trigger tests it. After an event x_s = y. Then updates arrive, and the controller ticks,
until step k + 1. Nothing is late.
"""

from copy import copy
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controller_node.controller import controllers_of
from netem.core.core_library import set_fields
from netem.core.errors import CallerError
from noack.core.core_library import core, ffi, new_handle, pointer_to
from noack.core.linear_systems import Matrix, Vector, discretise
from noack.scenario.estimation import assumed_model
from noack.scenario.resolution import loop_of, rule_of
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import network_delay_ns
from noack.theory.coverage import require_linear
from plant_server.plant import disturbance_of, measurement_model_of, plants_of
from sensor_node.sensor import sensors_of

Stack = NDArray[np.float64]
Numbers = NDArray[np.int64]
_POINTERS = {"i": "int64_t *", "f": "double *", "b": "uint8_t *"}


class Scales(NamedTuple):
    """Factors of the values of a run, by step, (K + 1,)."""

    weight: Matrix
    """W, (n, n)."""
    error: Vector
    state: Vector


class Runs(NamedTuple):
    """N runs, changed in place; r is the number of updates that may be in flight."""

    step: Numbers
    """The step of the event before, which is decided; −1 at a start that is no event, (N,)."""
    x: Matrix
    """(N, n), and the same for the next ones."""
    y: Matrix
    x_s: Matrix
    x_c: Matrix
    u: Matrix
    """The held input, (N, m)."""
    u_next: Matrix
    """The newest actuation, (N, m)."""
    sent: Matrix
    """The step of each update in flight, the oldest first; −1 for none, (N, r)."""
    updates: Stack
    """Their states, (N, r, n)."""
    auxiliary: Vector
    """η, or the integral, (N,)."""
    is_event: NDArray[np.bool_]
    """Whether the run reached an event, not the last step, (N,)."""
    error: Vector
    """The largest scaled ‖W e_c‖ since the event before; infinite if the run diverged, (N,)."""
    state: Vector
    """The largest scaled ‖x‖, (N,)."""
    cost: Vector
    """∫‖x‖² dt, as a sum over the steps, (N,)."""
    error_at: Numbers
    """Step of the largest ‖W e_c‖, (N,)."""
    state_at: Numbers


def _without_model(resolved: Scenario) -> Scenario:
    """Return the scenario with a watchdog that needs no model in the actuations.

    Its policy makes no difference: nothing is late, so the watchdog never acts.
    """
    watchdog = resolved.plant.watchdog.model_copy(update={"policy": "hold"})
    return resolved.model_copy(update={"plant": resolved.plant.model_copy(update={"watchdog": watchdog})})


class SampledLoop:
    """The loop of a resolved scenario; every delivered update takes the longest certified delay.

    Raises:
        CallerError: the loop is not linear between events, or the policy is not a rule.
    """

    def __init__(self, resolved: Scenario) -> None:
        coverage, timing = resolved.coverage, resolved.timing
        coverage.require_unchanging()
        require_linear(resolved)
        coverage.require_direct_inputs()
        if timing.actuation_timeout_ns <= timing.controller_period_ns + timing.plant_period_ns:
            raise CallerError(
                "plant.watchdog.timeout_s: shorter than the time between two inputs; "
                "give a time after which the watchdog acts on a failure only"
            )
        self.matrices, n = loop_of(resolved), resolved.model.dimensions[0]
        self.resolved = resolved
        self.last = timing.last_step
        self.step_s = float(timing.plant_period.exact) * 1e-9
        self.steps_per_measurement = resolved.plant.measure_every
        self.weight = np.eye(n) if self.matrices.weight is None else self.matrices.weight
        self.delay_ns = network_delay_ns(resolved, 0)
        self._first_auxiliary = rule_of(resolved).initial_dynamic_variable
        self._most_in_flight = self.delay_ns // timing.measurement_period_ns + 2
        assumed, measurements = assumed_model(resolved), self.last // self.steps_per_measurement + 1
        self._C, self._gains = assumed.C, np.zeros((0, n, len(assumed.C)))
        if resolved.observer is not None:
            self._gains = _dense(np.array([*islice(resolved.observer.gains_of(assumed), measurements)]))
        loops = (_without_model(resolved),)
        self._machines = (plants_of(loops), sensors_of(loops), controllers_of(loops))
        self._set_disturbances(state_increments(resolved), noise_of(resolved))

    def _set_disturbances(self, increments: Matrix, noise: Matrix) -> None:
        """Make a plant with these disturbances and noise."""
        matrices, n = self.matrices, self.matrices.n
        self._increments, self._noise = increments, noise
        lengths_ns = self.resolved.timing.plant_period.lengths_ns
        sources = np.array([discretise(matrices.A, matrices.B, length)[1] for length in lengths_ns])
        at_state = np.zeros((self.last + 1, n))
        if len(increments):
            at_state[: len(increments)] = increments
            sources = np.array([np.hstack([B, np.eye(n)]) for B in sources])
        settings = ffi.new("noack_plant *", self._machines[0].machines[0][0])
        set_fields(settings, {"Bd": sources, "applied": None, "at_input": {"width": 0, "values": None}})
        for name, values, count in (("at_state", at_state, len(increments)), ("noise", noise, len(noise))):
            signal = {"width": values.shape[1] if count else 0, "rows": len(values), "first": 0}
            set_fields(settings, {name: signal | {"values": values}})
        self._plant = new_handle("plant", settings)

    @property
    def known_start(self) -> bool:
        """Whether sensor and controller start from x(0), without a packet."""
        return self.resolved.network.initial_sync == "known_state"

    def start(self) -> Runs:
        """Return one run at its start: after the delivered first packet, if there is one."""
        known_start = self.known_start
        runs = self.empty(1)
        x0 = self.matrices.known_x0
        runs.x[0], runs.auxiliary[0], runs.step[0] = self.matrices.x0, self._first_auxiliary, -1
        if known_start:
            runs.x_s[0] = runs.x_c[0] = x0
        observer = self.resolved.observer
        if observer is not None and observer.initial_estimate is not None:
            runs.y[0] = observer.initial_estimate
        elif observer is not None and known_start:
            runs.y[0] = x0
        if not known_start:
            runs.step[0] = 0
            self.measure_at(runs)
            self.transmit(runs, np.array([True]))
        return runs

    @property
    def disturbances(self) -> tuple[Matrix, Matrix]:
        """The changes of x by the disturbance of each step, and the noise of each measurement."""
        return self._increments, self._noise

    def with_disturbances(self, increments: Matrix, noise: Matrix) -> "SampledLoop":
        """Return this loop with other disturbances and noise."""
        loop = copy(self)
        loop._set_disturbances(increments, noise)
        return loop

    def correction(self, numbers: Numbers) -> Stack:
        """Return the change of y by noise at each of k measurements, (k, n, p)."""
        if len(self._gains):
            return self._gains[numbers]
        return np.broadcast_to(np.eye(self.matrices.n), (len(numbers), *[self.matrices.n] * 2))

    def measure_at(self, runs: Runs) -> None:
        """Measure, where the step of a run is one of a measurement; y is 0 or estimated before."""
        for i in np.flatnonzero(runs.step % self.steps_per_measurement == 0).tolist():
            number = int(runs.step[i]) // self.steps_per_measurement
            noise = self._noise[number] if len(self._noise) else 0.0
            if len(self._gains):
                innovation = self._C @ (runs.x[i] - runs.y[i]) + noise
                runs.y[i] += self._gains[number] @ innovation
            else:
                runs.y[i] = runs.x[i] + noise

    def empty(self, count: int) -> Runs:
        """Return runs at 0."""
        n, m, r = self.matrices.n, self.matrices.m, self._most_in_flight
        return Runs(
            step=np.zeros(count, np.int64),
            x=np.zeros((count, n)), y=np.zeros((count, n)),
            x_s=np.zeros((count, n)), x_c=np.zeros((count, n)),
            u=np.zeros((count, m)), u_next=np.zeros((count, m)),
            sent=np.full((count, r), -1.0), updates=np.zeros((count, r, n)),
            auxiliary=np.zeros(count), is_event=np.zeros(count, np.bool_),
            error=np.zeros(count), state=np.zeros(count), cost=np.zeros(count),
            error_at=np.zeros(count, np.int64), state_at=np.zeros(count, np.int64),
        )  # fmt: skip

    def transmit(self, runs: Runs, delivered: NDArray[np.bool_]) -> None:
        """Make the events of runs: x_s = y, and send the update of the delivered ones, (N,)."""
        runs.x_s[:] = runs.y
        rows = np.flatnonzero(delivered)
        column = (runs.sent[rows] >= 0).sum(axis=1)
        runs.sent[rows, column] = runs.step[rows]
        runs.updates[rows, column] = runs.y[rows]

    def follow(self, runs: Runs, scales: Scales, last: Numbers, *, tests: bool = True) -> None:
        """Advance runs in place to their next events, at most to their steps ``last``, (N,).

        Without ``tests`` there are no events.
        """
        _, sensor, controller = (machines.machines[0] for machines in self._machines)
        if len(self._gains):
            sensor.observer.kind = core.NOACK_LUENBERGER
        weight = _dense(scales.weight)
        levels = [_dense(level) for level in (scales.error, scales.state)]
        segments = ffi.new("noack_segments *", {
            "plant": self._plant, "sensor": sensor, "controller": controller,
            "last": self.last, "delay_ns": self.delay_ns,
            "known_start": self.known_start, "runs": len(runs.step),
            "places": runs.sent.shape[1], "weight": pointer_to(weight, "double *"),
            "gains": pointer_to(self._gains, "double *") if len(self._gains) else ffi.NULL,
            "error_scale": pointer_to(levels[0], "double *"),
            "state_scale": pointer_to(levels[1], "double *"),
        })  # fmt: skip
        for name, array in runs._asdict().items():
            setattr(segments, name, pointer_to(array, _POINTERS[array.dtype.kind]))
        if (wrong := core.noack_segments_check(segments)) != ffi.NULL:
            raise ValueError(f"segments: {ffi.string(wrong).decode()}")
        last = np.ascontiguousarray(last, np.int64)
        core.noack_follow(segments, pointer_to(last, "int64_t *"), tests)


def disturbance_effect(resolved: Scenario) -> Matrix:
    """Return the effect of disturbances of u and of ẋ, held over a step, on x, (n, m + n)."""
    return _effect_over(resolved, resolved.timing.plant_period_ns)


def _effect_over(resolved: Scenario, length_ns: int) -> Matrix:
    matrices = loop_of(resolved)
    sources = np.hstack([matrices.B, np.eye(matrices.n)])
    return discretise(matrices.A, sources, length_ns)[1]


def state_increments(resolved: Scenario) -> Matrix:
    """Return the changes of x by the disturbance of each step, (steps, n); (0, n) for none."""
    disturbance, (n, m) = disturbance_of(resolved), resolved.model.dimensions
    if disturbance is None:
        return np.zeros((0, n))
    period, last = resolved.timing.plant_period, resolved.timing.last_step
    steps_ns, increments = np.diff(period.times_ns(np.arange(last + 1))), np.zeros((last, n))
    d, w = disturbance.values(range(last))
    for length_ns in period.lengths_ns:
        effect, has_length = _effect_over(resolved, length_ns), steps_ns == length_ns
        for part, matrix in ((d, effect[:, :m]), (w, effect[:, m:])):
            if part.shape[1]:
                increments[has_length] += part[has_length] @ matrix.T
    return increments


def noise_of(resolved: Scenario) -> Matrix:
    """Return the noise of each measurement, (measurements, p); (0, p) for none."""
    model = measurement_model_of(resolved)
    if model is None or not model.is_noisy:
        return np.zeros((0, resolved.message_sizes.outputs))
    return model.noise(0, resolved.timing.last_step // resolved.plant.measure_every + 1)


def _dense(matrix: Matrix | Numbers) -> Matrix:
    return np.ascontiguousarray(matrix, dtype=np.float64)
