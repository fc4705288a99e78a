"""The plant: a system on a time grid, under held inputs.

This file turns a scenario into the core's plant, whose steps are in native/loop/plant.c: at grid
time t_k = k h the plant advances its system to t_k under the input held since t_{k−1}; then it
measures, and latches the newest actuation received. The scenario defines the system
(``noack.plants``), its disturbance from t_k until t_{k+1} (``disturbance_signal.py``), its
measurement (``measurement.py``), and its watchdog (``watchdog.py``). If the system fails, x is NaN
from then on, as in a plant that diverges, and a notice gives the reason.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noack.config.scenario import Scenario
from noack.core.core_library import core
from noack.core.core_memory import CoreMemory, reals_at
from noack.core.linear_systems import Matrix, discretise
from noack.machines.loop_machines import LoopMachines
from noack.machines.machine_parts import Role, alike_parts, set_machine
from noack.plants.linear import LinearSystem
from noack.plants.plant_settings import PlantStart
from noack.plants.systems.plant_system import PlantSystem, SystemFailedError
from noack.protocol.machine_interface import BEGINNING, FAILED, Notice, Start
from noack.protocol.record_tables import NO_SEQUENCE, PLANT_ACTUATION, PLANT_STEP, RecordShape
from noack.protocol.wire_format import Flow
from plant_server.disturbance_signal import BLOCK, Disturbance, disturbance_of
from plant_server.measurement import MeasurementModel, measurement_model_of
from plant_server.watchdog import Watchdog, watchdog_notice, watchdog_of

PLANT = Role("plant", "noack_plant", Flow.ACTUATION, (PLANT_STEP, PLANT_ACTUATION, None))


@dataclass
class Plant:
    """The plant of one loop.

    Args:
        system: the system to advance, at x(0).
        inputs: m.
        watchdog: what is applied if the newest actuation is too old.
        period_ns: step h.
        horizon_ns: no step is due after this time.
        measure_every: number of steps per measurement.
        predictions: number of inputs of an actuation.
        input_period_ns: time between them, the period of the controller.
        disturbance: is added to u and to ẋ; None if there is none.
        measuring: the measurement model; None if y = x.
        reports_inputs: whether a measurement also carries the inputs of the steps since the last
            measurement. These are the latched inputs, without the disturbance.
    """

    system: PlantSystem
    inputs: int
    period_ns: int
    horizon_ns: int
    watchdog: Watchdog = field(default_factory=Watchdog)
    measure_every: int = 1
    predictions: int = 1
    input_period_ns: int = 1
    disturbance: Disturbance | None = None
    measuring: MeasurementModel | None = None
    reports_inputs: bool = False

    role = PLANT
    schedule = None
    counts_every_message = False

    @property
    def shape(self) -> RecordShape:
        """The sizes of the rows."""
        d, w = (0, 0) if self.disturbance is None else self.disturbance.widths
        return RecordShape(
            len(self.system.x), self.inputs, predictive=self.watchdog.is_predictive,
            predictions=self.predictions, internal=len(self.system.z),
            disturbed_input=d > 0, disturbed_state=w > 0,
        )  # fmt: skip

    def fill(self, plant: Any, memory: CoreMemory) -> None:
        """Fill a ``noack_plant`` at time 0."""
        n, m, shape = len(self.system.x), self.inputs, self.shape
        set_machine(
            plant.machine, n=n, m=m, flow=Flow.ACTUATION,
            entries=m * self.predictions + n * self.watchdog.is_predictive,
            period_ns=self.period_ns, horizon_ns=self.horizon_ns,
        )  # fmt: skip
        sources, shown = m + n * shape.disturbed_state, self.measure_every * self.reports_inputs
        C = None if self.measuring is None else self.measuring.C
        memory.fill(plant, {
            "internal": shape.internal, "system": core.NOACK_USER, "sources": sources,
            "C": C, "p": n if C is None else len(C),
            "measure_every": self.measure_every, "reports_inputs": self.reports_inputs,
            "predictions": self.predictions, "input_period_ns": self.input_period_ns,
            "newest_sequence": NO_SEQUENCE, "fallback_sequence": NO_SEQUENCE, "missing_ns": -1,
            "x": np.zeros(n), "z": np.zeros(shape.internal), "u": np.zeros(m),
            "applied": np.zeros(sources), "held": np.zeros((shown, m)),
            "inputs": np.zeros((self.predictions, m)), "x_c": np.zeros(n),
            "x_fallback": np.zeros(n), "scratch": np.zeros(2 * n + 2 * m),
        })  # fmt: skip
        if isinstance(self.system, LinearSystem):
            memory.fill(plant, {
                "system": core.NOACK_LINEAR, "Ad": np.zeros((n, n)), "Bd": np.zeros((n, sources)),
            })  # fmt: skip
        self.redraw(plant, memory)
        self.watchdog.fill(plant, memory, self.period_ns)
        widths = (0, 0) if self.disturbance is None else self.disturbance.widths
        noisy = self.measuring is not None and self.measuring.is_noisy
        for name, width in (
            ("at_input", widths[0]), ("at_state", widths[1]), ("noise", plant.p * noisy),
        ):  # fmt: skip
            signal = getattr(plant, name)
            signal.width, signal.rows, signal.first = width, BLOCK, -BLOCK
            signal.values = memory.zeros(BLOCK * width)

    def redraw(self, plant: Any, memory: CoreMemory) -> None:
        """Set the state, and the matrices of a linear system."""
        n, system = plant.machine.n, self.system
        reals_at(plant.x, n)[:], reals_at(plant.z, plant.internal)[:] = system.x, system.z
        if isinstance(system, LinearSystem):
            Ad, Bd = discretise(system.A, system.B, self.period_ns)
            reals_at(plant.Ad, n, n)[:], reals_at(plant.Bd, n, plant.sources)[:] = Ad, Bd

    def answer(self, question: int, plant: Any) -> Sequence[Notice]:
        """Compute the disturbances and the noise of the next steps, or advance the system."""
        if question == core.NOACK_ASK_SIGNALS:
            self._set_signals(plant)
            return ()
        assert question == core.NOACK_ASK_STATE
        plant.machine.answered = 1
        period_ns = self.period_ns
        t_ns = plant.machine.step * period_ns
        x, z = reals_at(plant.x, plant.machine.n), reals_at(plant.z, plant.internal)
        applied = reals_at(plant.applied, plant.sources).copy()
        try:
            self.system.advance(applied, t_ns - period_ns, period_ns)
        except SystemFailedError as error:
            plant.system = core.NOACK_FAILED
            x[:], z[:] = np.nan, np.nan
            return (Notice(t_ns, FAILED, str(error)),)
        x[:], z[:] = self.system.x, self.system.z
        return ()

    def inspect(self, rows: NDArray[np.void]) -> Sequence[Notice]:
        """Received actuations need no line in the log."""
        return ()

    def note(self, plant: Any, note: Any) -> Notice:
        """Return the line about actuations that are missing, or arrive again."""
        return watchdog_notice(self.watchdog, note)

    def _set_signals(self, plant: Any) -> None:
        step = plant.machine.step
        first = step - step % BLOCK
        if self.disturbance is not None:
            blocks = self.disturbance.block(first)
            for signal, values in zip((plant.at_input, plant.at_state), blocks, strict=True):
                if signal.width:
                    signal.first = first
                    reals_at(signal.values, BLOCK, signal.width)[:] = values
        if self.measuring is not None and plant.noise.width:
            number = plant.measurements - plant.measurements % BLOCK
            plant.noise.first = number
            reals_at(plant.noise.values, BLOCK, plant.noise.width)[:] = self.measuring.noise(number)


def plant_of(resolved: Scenario, start: Start = BEGINNING) -> LoopMachines:
    """Return the plant of a resolved scenario as a machine; a plant cannot be restarted."""
    return plants_of((resolved,))


def plants_of(
    loops: Sequence[Scenario], phases_ns: Sequence[int] | None = None, *, numbered: bool = False
) -> LoopMachines:
    """Return the plants of resolved loops as the machines of a process."""
    parts, alike = alike_parts(loops, _part, _redrawn)
    return LoopMachines(parts, phases_ns, alike=alike, numbered=numbered)


def _part(resolved: Scenario) -> Plant:
    return Plant(
        system_of(resolved),
        resolved.model.dimensions[1],
        period_ns=resolved.timing.plant_period_ns,
        horizon_ns=resolved.timing.horizon_ns,
        watchdog=watchdog_of(resolved),
        measure_every=resolved.plant.measure_every,
        predictions=resolved.controller.predictions,
        input_period_ns=resolved.timing.controller_period_ns,
        disturbance=disturbance_of(resolved),
        measuring=measurement_model_of(resolved),
        reports_inputs=resolved.observer is not None,
    )


def _redrawn(plant: Plant, resolved: Scenario) -> Plant:
    return replace(
        plant, system=system_of(resolved), disturbance=disturbance_of(resolved),
        measuring=measurement_model_of(resolved),
    )  # fmt: skip


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
    if any(one.at == "state" for one in plant.disturbances):
        B = np.hstack([B, np.eye(len(A))])
    start = PlantStart(np.array(plant.initial_state), A, B, resolved.timing.plant_period_ns)
    return plant.system.system(start)
