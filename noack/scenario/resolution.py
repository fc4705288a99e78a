"""From a scenario to a run: named models become matrices, random draws become numbers.

The result is again a scenario: the resolved scenario. Running it repeats the run's draws exactly.
:class:`ResolvedRun` has the numbers of a whole run: those of each loop, when the loops begin, and the
tables of the record. What follows from the resolved scenario of one loop is here, too: matrices, the
trigger's policy, and the tables of its record.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import cycle
from typing import Literal, NamedTuple

import numpy as np

from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError
from netem.core.random_streams import stream
from netem.core.settings_section import ScenarioSection
from noack.controllers.controller_settings import ControllerSettings
from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector, discretise, transition
from noack.core.references import Reference
from noack.observers.observer_settings import unobservable_mode
from noack.protocol.record_tables import (
    CONTROLLER_STEP,
    LOOP,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    RecordShape,
    is_of_network,
    largest,
    tables,
)
from noack.references.file import FilePiece
from noack.references.segment import SolutionSegment
from noack.scenario.controller_states import with_controller_states
from noack.scenario.estimation import assumed_model
from noack.scenario.loads import loaded_model, loaded_observer, loaded_plant, loaded_trigger
from noack.scenario.outputs import LoopOutput
from noack.scenario.overload import refuse_overload
from noack.scenario.references import scenario_segments
from noack.scenario.scenario import (
    Scenario,
    few_of,
    loop_names,
    loop_scenario,
    loop_sections,
    loop_seeds,
    loops_by_entry,
    loops_of,
)
from noack.scenario.scenario_checks import input_at
from noack.scenario.sections import AnyObserver, ModelSection, PlantSection
from noack.settings.values import rows_of
from noack.trigger_policies.periodic_trigger import PeriodicSettings
from noack.trigger_policies.trigger_rule import Policy, TriggerRule, require_rule

_SURELY_FINITE = 600.0
"""‖e^{At}‖ ≤ e^{‖A‖t}, and e^700 is finite; above this limit, the exponential itself is
computed."""


_CANCELLED = 1e-9
"""A sum that is a smaller share of its terms is 0, but for rounding."""


@dataclass(frozen=True)
class LoopMatrices:
    """The matrices of a resolved scenario, in the paper's notation (n states, m inputs)."""

    A_model: Matrix  # Â, (n, n)
    B_model: Matrix  # B̂, (n, m)
    K: Matrix  # gain, (m, n)
    H: Matrix
    """The matrix that both models integrate between updates, (n, n): Â + B̂K, or 0 in
    zero-order-hold mode."""
    A: Matrix  # true plant, (n, n); Â if the plant is not linear
    B: Matrix  # true plant, (n, m); B̂ if the plant is not linear
    x0: Vector  # x(0), (n,)
    weight: Matrix | None  # W of the trigger's norm, (n, n); None is the identity
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    reference: Reference | None = None  # x_r and u_r; None is 0
    loads: int = 0  # Number of the last states that are unknown constant loads
    outputs: tuple[LoopOutput, ...] = ()

    @property
    def known_x0(self) -> Vector:
        """x(0) as sensor and controller may know it, (n,): the loads are 0."""
        known = self.x0.copy()
        known[self.n - self.loads :] = 0.0
        return known

    @property
    def rest(self) -> Vector:
        """(Πd, d), (n,): where the loop rests under the loads d of x(0); 0 without loads."""
        own = self.n - self.loads
        rest = np.concatenate([np.zeros(own), self.x0[own:]])
        if rest.any():
            closed_loop = self.A + self.B @ self.K
            inverse = np.linalg.pinv(closed_loop[:own, :own])
            moved = inverse @ closed_loop[:own, own:] @ rest[own:]
            terms = np.abs(inverse) @ (np.abs(self.A) + np.abs(self.B) @ np.abs(self.K))[:own, own:]
            is_rounding = np.abs(moved) <= _CANCELLED * (terms @ np.abs(rest[own:]))
            rest[:own] = np.where(is_rounding, 0.0, -moved)
        return rest

    @property
    def without_loads(self) -> "LoopMatrices":
        """The loop of the plant's states alone: the loads are known and compensated."""
        k = self.n - self.loads
        return replace(
            self, A_model=self.A_model[:k, :k], B_model=self.B_model[:k], K=self.K[:, :k],
            H=self.H[:k, :k], A=self.A[:k, :k], B=self.B[:k], x0=self.x0[:k],
            weight=None if self.weight is None else self.weight[:k, :k],
            reference=None if self.reference is None else self.reference.of_states(k),
            state_names=self.state_names[:k], loads=0,
            outputs=tuple(output._replace(row=output.row[:k]) for output in self.outputs),
        )  # fmt: skip

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.B.T)


def resolve(scenario: Scenario) -> Scenario:
    """Return a scenario of one loop with matrices and numbers in place of names and random draws.

    Raises:
        CallerError: the numbers are so large that one step of the plant or model is not finite; an
            observer is set, but an unstable mode is unobservable in the measurement; or a module
            that the plant needs is not installed; or the scenario has more than one loop, see
            :func:`resolved_loops`.
    """
    if (count := len(names := loop_names(scenario))) > 1:
        raise CallerError(
            f"{scenario.name}: the scenario has {count} loops, and this is for one: choose it with --loop "
            f"NAME if the command has that option; they are {few_of(names)}"
        )
    return resolved_loops(scenario)[0]


class LoopEntry(NamedTuple):
    """The loops of an entry of [[loops]]; they differ in their seeds and draws only."""

    name: str
    scenario: Scenario
    """Of one loop, with the seeds of the run."""
    loops: int
    """Number of loops."""
    phase: float | None
    """When they begin, in periods; None: each draws it."""


class ResolvedRun:
    """A run with all its numbers; its processes, its simulation and its record are made from it.

    Args:
        scenario: of the run, as :func:`resolve_run` returns it and a run directory has it.
        loops: the resolved scenario of each loop, if they are known.
    """

    def __init__(self, scenario: Scenario, loops: Sequence[Scenario] | None = None) -> None:
        self.scenario = scenario
        self._known_loops = loops

    @cached_property
    def loops(self) -> Sequence[Scenario]:
        """(loops,) The resolved scenario of each loop."""
        return resolved_loops(self.scenario) if self._known_loops is None else self._known_loops

    @cached_property
    def entries(self) -> Sequence[LoopEntry]:
        """The entries of [[loops]]; a scenario without has one."""
        return [
            LoopEntry(section.name, loop_scenario(self.scenario, section), section.count, section.phase)
            for section in loop_sections(self.scenario)
        ]

    @cached_property
    def names(self) -> Sequence[str]:
        """(loops,) The name of each loop."""
        return loop_names(self.scenario)

    @cached_property
    def phases_ns(self) -> Sequence[int]:
        """(loops,) When each loop begins: the time of the run at which the time of the loop is 0."""
        is_drawn = any(entry.phase is None for entry in self.entries)
        seeds = loop_seeds(self.scenario, ("initial_state",)) if is_drawn else []
        phases_ns: list[int] = []
        for _, loop, count, phase in self.entries:
            period_ns = _phase_period_ns(loop)
            for number in range(len(phases_ns), len(phases_ns) + count):
                drawn = _drawn_phase(seeds[number].initial_state, number) if phase is None else phase
                phases_ns.append(int(drawn * period_ns))
        return tuple(phases_ns)

    @property
    def wall_s(self) -> float:
        """Wall time from its start to its horizon."""
        return self.scenario.horizon_s / self.scenario.speed

    @property
    def end_ns(self) -> int:
        """The last horizon of all loops."""
        return self.scenario.timing.horizon_ns + max(self.phases_ns)

    @cached_property
    def tables(self) -> Mapping[str, np.dtype[np.void]]:
        """The row types of the tables, as its processes send them.

        The rows of the network are those of all loops; each other row of a machine begins with the
        number of its loop. Vectors have the largest size of all loops.
        """
        shapes = {shape_of(entry.scenario) for entry in self.entries}
        return {
            table: dtype if is_of_network(table) else np.dtype([(LOOP, "<u2"), *dtype.descr])
            for table, dtype in tables(**vars(largest(shapes))).items()
        }

    @property
    def step_bytes(self) -> int:
        """Bytes of the rows of all steps; the number of rows of events is not known in advance."""
        return sum(entry.loops * _step_bytes(entry.scenario) for entry in self.entries)


def _step_bytes(loop: Scenario) -> int:
    """Return the bytes of a loop's rows on fixed time grids."""
    timing, types = loop.timing, tables_of(loop)
    steps = timing.horizon_ns // timing.plant_period_ns + 1
    ticks = timing.horizon_ns // timing.controller_period_ns
    rows = {
        PLANT_STEP: steps,
        SENSOR_MEASUREMENT: steps // loop.plant.measure_every,
        CONTROLLER_STEP: ticks,
        PLANT_ACTUATION: ticks,
    }
    return sum(count * types[table].itemsize for table, count in rows.items())


def _phase_period_ns(loop: Scenario) -> int:
    """Return the time between two transmissions of a periodic trigger, else two measurements."""
    if isinstance(loop.trigger, PeriodicSettings):
        return round(loop.trigger.period_s * NS_PER_S)
    return loop.timing.measurement_period_ns


def _drawn_phase(seed: int, number: int) -> float:
    """Return when the loop of a number begins, in periods; the first one begins at once."""
    return float(stream(seed, "phase", str(number)).uniform()) if number else 0.0


def resolve_run(scenario: Scenario) -> ResolvedRun:
    """Return a run; the scenario in it repeats the run's draws.

    A scenario without [[loops]] is resolved. In an entry of [[loops]], the model, the observer and
    the reference become numbers; the draws of its loops follow from the seeds.

    Raises:
        CallerError: as :func:`resolve`, or a link must overflow, in a scenario that no file gives.
    """
    try:
        refuse_overload(scenario)
    except ValueError as error:
        raise CallerError(f"{scenario.name}: {error}") from None
    resolved = resolved_loops(scenario)
    if not scenario.loops:
        return ResolvedRun(resolved[0], resolved)
    sections, first = [], 0
    for section in scenario.loops:
        loop, first = resolved[first], first + section.count
        given = loop_scenario(scenario, section)
        if given.model.load is not None or given.controller.states:  # the processes add these states
            sections.append(section)
            continue
        tables: dict[str, ScenarioSection | None] = {"model": loop.model, "observer": loop.observer}
        if loop.trigger != given.trigger:
            tables["trigger"] = loop.trigger
        if loop.controller.reference is not None:
            tables["controller"] = loop.controller
        update = {part: table.content() for part, table in tables.items() if table is not None}
        sections.append(section.model_copy(update=update))
    return ResolvedRun(scenario.model_copy(update={"loops": tuple(sections)}), resolved)


def resolved_loops(scenario: Scenario) -> tuple[Scenario, ...]:
    """Return the resolved scenario of each loop of a run.

    Raises:
        CallerError: as :func:`resolve`.
    """
    return tuple(loop for loops in loops_by_entry(scenario) for loop in _resolved(loops))


def loop_named(scenario: Scenario, name: str | None) -> Scenario:
    """Return the scenario of the loop of a name, alone; without a name, the scenario.

    Raises:
        CallerError: there is no such loop.
    """
    if name is None:
        return scenario
    if name not in (names := loop_names(scenario)):
        raise CallerError(f"--loop {name}: the loops of the scenario are {few_of(names)}")
    return loops_of(scenario)[names.index(name)]


def _resolved(loops: Sequence[Scenario]) -> list[Scenario]:
    """Return the resolved scenarios of loops that differ in their names and seeds only.

    Unknown loads (``loads.py``) and states of the controller (``controller_states.py``) become further
    states of the model, if there are any; a reference becomes segments (``references.py``).
    """
    scenario, plant = loops[0], loops[0].plant
    explicit = _explicit_model(scenario.named_model)
    is_drawn = (
        plant.initial_state_halfwidth is not None
        or plant.load_halfwidth is not None
        or plant.draw in ("uniform", "vertex")
    )
    plants = [_resolved_plant(loop, explicit) for loop in (loops if is_drawn else loops[:1])]
    model = explicit if explicit.load is None else loaded_model(explicit)
    if scenario.mode == "model":
        A, B, K = np.array(model.A), np.array(model.B), np.array(model.gain)
        _require_finite("model", A + B @ K, K.T, scenario.timing.controller_period_ns)
    shared: dict[str, object] = {"model": model, "plant": plants[0], "controller": _controller(scenario)}
    if explicit.load is not None:
        shared["trigger"] = loaded_trigger(explicit, scenario.trigger)
        shared["observer"] = loaded_observer(scenario.model_copy(update=shared))
    else:
        shared["observer"] = _observer(scenario, model)
    n = model.dimensions[0] + scenario.controller.states
    if scenario.outputs is not None:
        shared["outputs"] = tuple(
            section.model_copy(update={"row": (*output.row, *(0.0,) * (n - len(output.row)))})
            for section, output in zip(scenario.outputs, scenario.loop_outputs(), strict=True)
        )
    resolved = [
        loop.model_copy(update={**shared, "plant": own_plant})
        for loop, own_plant in zip(loops, cycle(plants), strict=False)
    ]
    resolved = [*map(with_controller_states, resolved)] if scenario.controller.states else resolved
    computed = _computed_numbers(resolved[0])
    return [loop.model_copy(update=computed) for loop in resolved]


def _computed_numbers(resolved: Scenario) -> dict[str, object]:
    """Return the tables with numbers that a sensor would compute: the trigger's P, a filter's gains."""
    trigger = resolved.trigger.resolved(resolved.model.trigger_matrices)
    if resolved.observer is None:
        return {"trigger": trigger}
    return {"trigger": trigger, "observer": resolved.observer.with_gains(assumed_model(resolved))}


def _resolved_plant(loop: Scenario, model: ModelSection) -> PlantSection:
    """Return the plant of a loop with numbers in place of random draws."""
    plant, update = loop.plant, dict[str, object]()
    A, B, x0 = np.array(model.A), np.array(model.B), np.array(plant.initial_state)
    if plant.initial_state_halfwidth is not None:
        rng = stream(loop.seeds.initial_state, "initial_state")
        x0 += np.array(plant.initial_state_halfwidth) * rng.uniform(-1, 1, len(x0))
    if plant.draw == "given":
        A, B = np.array(plant.A), np.array(plant.B)
    elif plant.draw in ("uniform", "vertex"):
        rng = stream(loop.seeds.plant, "plant")
        A = A + _perturbation(rng, plant.draw, plant.uncertainty_A, A.shape)
        B = B + _perturbation(rng, plant.draw, plant.uncertainty_B, B.shape)
    _require_finite("plant", A, B, loop.timing.plant_period_ns)
    if loop.coverage.is_linear:
        update = {"draw": "given", "A": rows_of(A), "B": rows_of(B)}
    update |= {"initial_state": tuple(x0.tolist()), "initial_state_halfwidth": None}
    resolved = plant.model_copy(update=update)
    if model.load is None:
        return resolved
    load = np.zeros(model.loads) if plant.load is None else np.array(plant.load)
    if plant.load_halfwidth is not None:
        unit = stream(loop.seeds.initial_state, "load").uniform(-1, 1, len(load))
        load += np.array(plant.load_halfwidth) * unit
    return loaded_plant(loop.model_copy(update={"model": model}), resolved, load)


def _explicit_model(model: ModelSection) -> ModelSection:
    if model.name is not None:
        named_model = model.named
        return ModelSection(
            A=rows_of(named_model.A),
            B=rows_of(named_model.B),
            gain=model.gain or rows_of(named_model.K),
            state_names=model.state_names,
            state_units=model.state_units,
            input_names=model.input_names,
            load=model.load,
            hold=model.hold,
            allow_unstable=model.allow_unstable,
        )
    return model


def _controller(scenario: Scenario) -> ControllerSettings:
    """Return the controller with its reference, or the set-point of one with states, as segments."""
    controller = scenario.controller
    if isinstance((controller.reference or (None,))[0], FilePiece):
        return controller  # the rows of a file stay, which are shorter
    if (segments := scenario_segments(scenario)) is None:
        return controller
    n = len(segments[0].polynomial.T) - scenario.model.dimensions[1]
    pieces = tuple(SolutionSegment.of(segment, n) for segment in segments)
    return controller.model_copy(update={"reference": pieces, "setpoint": None})


def _perturbation(
    rng: "np.random.Generator",
    draw: Literal["uniform", "vertex"],
    halfwidth: tuple[tuple[float, ...], ...] | None,
    shape: tuple[int, int],
) -> Matrix:
    # One draw per entry of the matrix: a change of one entry's interval leaves the other draws
    # unchanged.
    unit = rng.uniform(-1.0, 1.0, shape)
    if draw == "vertex":
        unit = np.where(unit < 0, -1.0, 1.0)
    return np.zeros(shape) if halfwidth is None else np.array(halfwidth) * unit


def _observer(scenario: Scenario, model: ModelSection) -> AnyObserver | None:
    """Return the observer with its gain; refuse it if an unstable mode is unobservable."""
    observer = scenario.observer
    if observer is None:
        return None
    A = np.array(model.A)
    C = scenario.plant.measurement.matrix(len(A))
    period_ns = float(scenario.timing.measurement_period.exact)
    with np.errstate(all="ignore"):
        step = transition(A, period_ns)
    if not np.isfinite(step).all():
        raise CallerError(
            "model.A: e^(AT) is not finite, T being the time between measurements; check its size"
        )
    if (mode := unobservable_mode(step, C)) is not None:
        rate_per_s = np.log(mode) / (period_ns * 1e-9)
        rate = f"{rate_per_s.real:.3g}" + (f"{rate_per_s.imag:+.3g}j" if rate_per_s.imag else "")
        raise CallerError(
            f"plant.measurement.C: the model's mode e^({rate} t) does not decay and does not "
            "appear in what is measured; no observer can estimate it"
        )
    return observer.resolved(step, C, period_ns)


def _require_finite(key: str, A: Matrix, B: Matrix, step_ns: int) -> None:
    with np.errstate(all="ignore"):
        if np.linalg.norm(A, 1) * step_ns * 1e-9 < _SURELY_FINITE and np.isfinite(B).all():
            return
        try:
            finite = all(np.isfinite(block).all() for block in discretise(A, B, step_ns))
        except ValueError:  # scipy raises it for infinite entries
            finite = False
    if not finite:
        sizes = ", ".join(f"{name} to {np.abs(M).max():.3g}" for name, M in (("A", A), ("B", B)))
        raise CallerError(
            f"{key}: these matrices take one step to infinity, with entries of {sizes}; check their units"
        )


@cached_method
def loop_of(resolved: Scenario) -> LoopMatrices:
    """Return the matrices of a resolved scenario."""
    model, plant = resolved.model, resolved.plant
    A_model, B_model, K = np.array(model.A), np.array(model.B), np.array(model.gain)
    H = A_model + B_model @ K if resolved.mode == "model" else np.zeros_like(A_model)
    weight = resolved.trigger.weight
    matrices = LoopMatrices(
        A_model=A_model,
        B_model=B_model,
        K=K,
        H=H,
        A=A_model if plant.A is None else np.array(plant.A),
        B=B_model if plant.B is None else np.array(plant.B),
        x0=np.array(plant.initial_state),
        weight=None if weight is None else np.array(weight),
        reference=reference_of(resolved),
        state_names=model.state_names or (),
        input_names=model.input_names or (),
        loads=model.load_states,
        outputs=resolved.loop_outputs(),
    )
    for array in vars(matrices).values():
        if isinstance(array, np.ndarray):
            array.flags.writeable = False
    return matrices


@cached_method
def policy_of(resolved: Scenario) -> Policy:
    """Return a resolved scenario's trigger policy; raise CallerError if its model excludes it."""
    return resolved.trigger.trigger_policy(resolved.model.trigger_matrices)


def rule_of(resolved: Scenario) -> TriggerRule:
    """Return a resolved scenario's trigger rule; raise CallerError if it has none."""
    return require_rule(policy_of(resolved))


def setpoint_of(resolved: Scenario) -> tuple[Vector, Vector] | None:
    """Return the set point x_r, (n,), of a resolved scenario, and u_r, (m,); None if it is 0."""
    setpoint = resolved.controller.setpoint
    if not any(setpoint or ()):
        return None
    x_r = np.concatenate([setpoint, np.zeros(resolved.model.load_states)])
    return x_r, input_at(*resolved.model.matrices, x_r)


@cached_method
def reference_of(resolved: Scenario) -> Reference | None:
    """Return the reference of a resolved scenario: its pieces, or its set-point; None if it is 0."""
    segments, setpoint = scenario_segments(resolved), setpoint_of(resolved)
    if segments is not None:
        (n, m), states = resolved.model.dimensions, resolved.model.followed_states
        columns = [*range(states), *[-1] * (n - states), *range(states, states + m)]  # loads are 0
        return Reference([segment.of_columns(columns) for segment in segments], n)
    return None if setpoint is None else Reference.constant(*setpoint)


@cached_method
def tables_of(resolved: Scenario) -> Mapping[str, np.dtype[np.void]]:
    """Return the row types of the tables of a loop, from its resolved scenario."""
    return tables(**vars(shape_of(resolved)))


def shape_of(resolved: Scenario) -> RecordShape:
    """Return the sizes of a loop's vectors in the record."""
    n, m = resolved.states, resolved.model.dimensions[1]
    disturbed = {disturbance.at for disturbance in resolved.plant.disturbances}
    if resolved.plant.load_changes:
        disturbed.add("state")
    return RecordShape(
        n,
        m,
        acknowledged=resolved.protocol.acknowledges,
        carries_model=resolved.message_sizes.carries_model,
        internal=len(resolved.plant.system.internal_names),
        predictions=resolved.controller.predictions,
        disturbed_input="input" in disturbed,
        disturbed_state="state" in disturbed,
        outputs=resolved.message_sizes.outputs if resolved.estimates_state else 0,
        inputs_reported=resolved.message_sizes.inputs_reported,
    )
