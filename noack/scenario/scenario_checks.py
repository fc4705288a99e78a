"""Checks of a scenario that concern several of its tables, and changes of its runtime parameters.

A change of settings during a run gives another scenario, to which the same checks apply.

A set point is an equilibrium of the model, Âx_r + B̂u_r = 0. With u = K(x_c − x_r) + u_r both models
follow dx/dt = H(x − x_r). All statements about x, x_s and x_c then hold for x − x_r, x_s − x_r and
x_c − x_r, with a constant disturbance if the plant does not rest at x_r
(:mod:`noack.theory.certificates.conditions`).
"""

import json
from itertools import pairwise
from typing import TypeVar

import numpy as np
from pydantic import ValidationError

from netem.core.clock import NS_PER_S
from netem.core.settings_section import ReadTable, ScenarioSection, Table
from netem.core.toml_file import explain
from netem.impairments.constraints import require_consistent
from netem.impairments.link_settings import Constraints, Mansd, require_scores
from netem.impairments.loss_models import Loss
from netem.impairments.loss_models.trace import TraceLoss
from netem.impairments.target_loss import number_of_target_loss, with_target_loss
from noack.core.linear_systems import Matrix, Vector
from noack.protocol.wire_format import MAX_DIMENSION
from noack.scenario.controller_states import check_controller_states
from noack.scenario.loads import check_loads, noise_with_loads
from noack.scenario.references import PieceError, scenario_segments
from noack.scenario.runtime_parameters import LOSS, put_settings, require_runtime_parameters
from noack.scenario.scenario_tables import ScenarioTables
from noack.scenario.sections import AnyController, AnyTrigger, NetworkSection
from noack.scenario.symbols import ScenarioRoot
from noack.settings.values import require_length, require_shape

S = TypeVar("S", bound=ScenarioTables)


class _ChangedNetwork(ScenarioSection):
    """The keys of the network that a change may set."""

    loss: Loss | None = None
    mansd: Mansd | None = None
    constraints: Constraints | None = None


class _Change(ScenarioRoot):
    """The tables of a scenario in which a change may set keys; None: it sets none."""

    trigger: AnyTrigger | None = None
    controller: AnyController | None = None
    network: _ChangedNetwork | None = None


_ROUNDING = 1e-9  # largest Âx_r + B̂u_r that is taken as 0, relative to the larger term


def check_sections(scenario: ScenarioTables) -> None:
    """Raise ValueError if two sections do not fit together; the message begins with the key."""
    timing = scenario.timing
    if timing.horizon_ns < timing.plant_period_ns:
        raise ValueError(f"horizon_s: shorter than one plant step ({timing.plant_period_ns / NS_PER_S} s)")
    if timing.measurement_period_ns > 10**9 * NS_PER_S:
        raise ValueError("plant.measure_every: more than 1e9 s between two measurements")
    _check_plant(scenario)
    m = scenario.model.dimensions[1]
    require_length(scenario.controller.safe_input, "controller.safe_input", m, "one per input")
    if scenario.controller.states:  # the model's gain is only a part of the loop
        check_controller_states(scenario)
    else:
        scenario.model.require_stable()
    check_setpoint(scenario)
    check_loads(scenario)
    check_reference(scenario)
    _check_observer(scenario)
    _check_watchdog(scenario)
    _check_use_of_gain(scenario)
    _check_actuation_size(scenario)
    check_trigger(scenario)
    check_target_loss(scenario)
    scenario.loop_outputs()


def check_target_loss(scenario: ScenarioTables) -> None:
    """Raise ValueError if a loss rate cannot be kept; with a trace, as soon as it has been read."""
    network = scenario.network
    for key, section in network.directions.items():
        losses = [getattr(impairment, "loss", None) for impairment in section.link.impairments]
        if any(isinstance(loss, TraceLoss) for loss in losses):
            continue
        try:
            with_target_loss(section.link)
        except ValueError as error:
            number = number_of_target_loss(section.link)  # the first one is that of the table itself
            place = f"{key}.impairments.{number - 1}" if number else key
            raise ValueError(f"{place}.loss: {error}") from None


def check_trigger(scenario: ScenarioTables) -> None:
    """Raise ValueError unless the trigger fits the model's dimensions and measurement period."""
    scenario.trigger.check(scenario.model.dimensions[0], _dimensions(scenario))
    scenario.trigger.check_period(scenario.timing.measurement_period)


def check_setpoint(scenario: ScenarioTables) -> None:
    """Raise ValueError unless the model can rest at the set point and other settings allow one."""
    key, setpoint = "controller.setpoint", scenario.controller.setpoint
    n = scenario.model.plant_states
    require_length(setpoint, key, n, "one per state")
    if setpoint is None:
        return
    if scenario.controller.reference is not None:
        raise ValueError(f"{key}: not with controller.reference, of which a piece of kind step is one")
    _require_reference_possible(scenario, key)
    try:
        A, B = scenario.model.matrices
        input_at(A[:n, :n], B[:n], np.array(setpoint))
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None


def check_reference(scenario: ScenarioTables) -> None:
    """Raise ValueError unless the model can follow the reference and other settings allow one."""
    key, pieces = "controller.reference", scenario.controller.reference
    if pieces is None:
        return
    _require_reference_possible(scenario, key)
    try:
        scenario_segments(scenario)
    except PieceError as error:
        raise ValueError(f"{key}.{error.place}.{error}") from None


def _require_reference_possible(scenario: ScenarioTables, key: str) -> None:
    """Raise ValueError if another setting has no reference other than 0."""
    if scenario.protocol.acknowledges:
        raise ValueError(f'{key}: not with network.protocol = "ack"')
    if scenario.message_sizes.carries_model:
        raise ValueError(
            f'{key}: the plant\'s watchdog does not have it; use plant.watchdog.policy = "hold" or "zero"'
        )


def input_at(A: Matrix, B: Matrix, x_r: Vector) -> Vector:
    """Return u_r, (m,), with which a model rests at x_r, (n,): the solution of smallest norm.

    Raise ValueError, which names the nearest equilibrium, if it cannot rest there.
    """
    drift = A @ x_r
    u_r = np.asarray(np.linalg.lstsq(B, -drift, rcond=None)[0], dtype=np.float64)
    residual = np.abs(drift + B @ u_r)
    largest = max(float(np.abs(drift).max()), float(np.abs(A).max() * np.abs(x_r).max()))
    if not x_r.any() or (np.isfinite(residual).all() and residual.max() <= _ROUNDING * largest):
        return u_r
    states = _equilibria(A, B)
    if not states.shape[1]:
        raise ValueError("no equilibrium of the model, which has none but 0: Âx + B̂u = 0")
    nearest = states @ (states.T @ x_r)
    nearest_text = ", ".join(f"{value:.12g}" for value in np.where(np.abs(nearest) < 1e-12, 0.0, nearest))
    raise ValueError(
        f"no equilibrium of the model (Âx + B̂u = 0); those are a space of dimension "
        f"{states.shape[1]}, and the nearest one is [{nearest_text}]"
    )


def _equilibria(A: Matrix, B: Matrix) -> Matrix:
    """Return an orthonormal basis of all x with Âx in the range of B̂, (n, k)."""
    blocked = A - B @ (np.linalg.pinv(B) @ A)
    _, sizes, directions = np.linalg.svd(blocked)
    scale = max(float(np.abs(A).max()), np.finfo(float).tiny)
    return np.ascontiguousarray(directions[(sizes > _ROUNDING * scale).sum() :].T)


def _check_plant(scenario: ScenarioTables) -> None:
    (n, m), plant, dimensions = scenario.model.dimensions, scenario.plant, _dimensions(scenario)
    require_shape(plant.uncertainty_A, "plant.uncertainty_A", (n, n), dimensions)
    require_shape(plant.uncertainty_B, "plant.uncertainty_B", (n, m), dimensions)
    require_shape(plant.A, "plant.A", (n, n), dimensions)
    require_shape(plant.B, "plant.B", (n, m), dimensions)
    for key in ("initial_state", "initial_state_halfwidth"):
        require_length(getattr(plant, key), f"plant.{key}", n, "one per state")
    plant.system.check(scenario.model.plant_states, m)
    _check_disturbances(scenario)
    plant.measurement.check(n, dimensions)


def _check_disturbances(scenario: ScenarioTables) -> None:
    n, m = scenario.model.dimensions
    for number, disturbance in enumerate(scenario.plant.disturbances):
        place = f"plant.disturbances.{number}"
        if disturbance.at == "state" and not scenario.coverage.is_linear:
            raise ValueError(
                f'{place}.at: "state" needs a linear plant; this one can be disturbed at "input"'
            )
        size, reason = (m, "one per input") if disturbance.at == "input" else (n, "one per state")
        key = f"{place}.{disturbance.entries_key}"
        require_length(disturbance.entries, key, size, f'at = "{disturbance.at}": {reason}')


def _check_observer(scenario: ScenarioTables) -> None:
    (n, m), plant, observer = scenario.model.dimensions, scenario.plant, scenario.observer
    sizes = scenario.message_sizes
    if not scenario.estimates_state:
        if not plant.measurement.selects_all(n):
            raise ValueError(
                "plant.measurement.C: without an [observer] the sensor has to measure every "
                "state; give an [observer], or no C"
            )
        return
    if observer is not None:
        observer.check(scenario.model.states, m, sizes.outputs, noise_with_loads(scenario))
    if sizes.measurement_entries > MAX_DIMENSION:
        raise ValueError(
            "plant.measure_every: with an observer a measurement carries y and the inputs of "
            f"{plant.measure_every} steps, {sizes.outputs} + {sizes.inputs_reported} numbers; "
            f"at most {MAX_DIMENSION} fit"
        )


def _check_watchdog(scenario: ScenarioTables) -> None:
    """Raise ValueError if inputs that a message carries would be cut off by the timeout."""
    timing = scenario.timing
    if timing.actuation_timeout_ns < timing.predicted_ns:
        several = "" if scenario.controller.predictions == 1 else " times controller.predictions"
        raise ValueError(
            f"plant.watchdog.timeout_s: shorter than a period of the controller{several} "
            f"({timing.predicted_ns / NS_PER_S} s)"
        )


def _check_use_of_gain(scenario: ScenarioTables) -> None:
    """Raise ValueError if a setting uses u = K x_c and the controller has another law."""
    controller = scenario.controller
    if controller.is_linear:
        return
    uses = {
        "controller.predictions: needs": controller.predictions > 1,
        "controller.update_timeout_s: needs": controller.update_timeout_s is not None,
        'plant.watchdog.policy: "model" predicts': scenario.message_sizes.carries_model,
    }
    for text, is_used in uses.items():
        if is_used:
            raise ValueError(f'{text} u = K x_c; not with controller.kind = "{controller.kind}"')


def _check_actuation_size(scenario: ScenarioTables) -> None:
    """Raise ValueError if the numbers of an actuation do not fit into a message."""
    if scenario.message_sizes.actuation_entries <= MAX_DIMENSION:
        return
    n, m = scenario.states, scenario.model.dimensions[1]
    carries_model = scenario.message_sizes.carries_model
    if (predictions := scenario.controller.predictions) > 1:
        state_text = f" and {n} of x_c" if carries_model else ""
        raise ValueError(
            f"controller.predictions: an actuation carries {predictions} x {m} inputs{state_text}; "
            f"at most {MAX_DIMENSION} numbers fit"
        )
    raise ValueError(
        'plant.watchdog.policy: with "model" an actuation carries u and x_c, '
        f"{m} + {n} numbers; at most {MAX_DIMENSION} fit"
    )


def _dimensions(scenario: ScenarioTables) -> str:
    n, m = scenario.model.dimensions
    return f"the model has {n} states and {m} inputs"


def check_changes(scenario: ScenarioTables) -> None:
    """Raise ValueError if a scheduled change is not possible, or the changes are not in order."""
    for (index, earlier), (_, later) in pairwise(enumerate(scenario.changes)):
        if later.at_s < earlier.at_s:
            raise ValueError(f"changes.{index + 1}.at_s: earlier than the change before it")
    changed = scenario
    for index, change in enumerate(scenario.changes):
        if change.at_ns >= scenario.timing.horizon_ns:
            raise ValueError(f"changes.{index}.at_s: the run ends at {scenario.horizon_s:g} s")
        try:
            changed = with_settings(changed, change.set)
        except ValueError as error:
            raise ValueError(f"changes.{index}.set: {str(error).splitlines()[0]}") from None


def prepare_changes() -> None:
    """Build the validators of changes, which takes 20 ms, before a loop needs them."""
    _Change.model_rebuild()


def with_settings(scenario: S, settings: ReadTable) -> S:
    """Return a scenario with other values of its runtime parameters.

    Only the parts that change are validated: the processes of a run do this in their loop. Raise
    ValueError, with one line per mistake, if a key is not a runtime parameter, or the scenario
    would be invalid.
    """
    if scenario.protocol.acknowledges:
        raise ValueError('network.protocol: with "ack", nothing can be changed during a run')
    require_runtime_parameters(settings, scenario.trigger)
    sections = {key.split(".")[0] for key in settings}
    changes_loss = any(key.startswith(LOSS) for key in settings)
    content: Table = {name: getattr(scenario, name).content() for name in sections - {"network"}}
    if "network" in sections:
        loss = scenario.network.loss.content()
        content["network"] = {"loss": loss} if changes_loss else {}
    put_settings(content, settings)
    try:
        change = _Change.model_validate_json(json.dumps(content))
    except ValidationError as error:
        lines = (line.removeprefix(": ") for line in explain(error, "", _Change))
        raise ValueError("\n".join(lines)) from None
    update = {name: getattr(change, name) for name in sections}
    if change.network is not None:
        update["network"] = _changed_network(scenario.network, change.network)
    changed = scenario.model_copy(update={**update, "changes": ()})
    check_trigger(changed)
    check_setpoint(changed)
    check_target_loss(changed)
    return changed


def _changed_network(network: NetworkSection, change: _ChangedNetwork) -> NetworkSection:
    """Return the network with the keys that the change sets; raise ValueError if they do not fit."""
    if isinstance(change.loss, TraceLoss):
        raise ValueError(
            "network.loss.model: a trace is read before a run begins; give its losses as "
            '{ model = "scripted", lost = [...] }'
        )
    changed = network.model_copy(update={name: getattr(change, name) for name in change.model_fields_set})
    require_consistent(changed.mansd, changed.constraints)
    require_scores(changed.impairments, changed.loss)
    return changed
