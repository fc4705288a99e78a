"""A controller with states of its own: they belong to the model, and to every update.

The controller is dξ/dt = A_c ξ + B_c x, u = C_c ξ + D_c x. If only x were sent, errors of the
controller's ξ would never be corrected. So ξ belongs to what is measured and sent: it is computed from
the measured x, exactly, where x is measured. Sensor and controller predict (x, ξ) by

    d/dt (x, ξ) = [Â, 0; B_c, A_c] (x, ξ) + [B̂; 0] u,   u = [D_c, C_c] (x, ξ),

and an update replaces both. So this is the loop of the paper for a plant with the states (x, ξ), and
everything that is known of such loops holds for it. A resolved scenario has ξ in its matrices, at the
end of the model's and of the plant's states, and u = Kx for its controller.

With a set-point or a reference x_r the controller is driven by x − x_r. Then ξ_r solves
dξ_r/dt = A_c ξ_r + B_c x_r, so (x_r, ξ_r) is a reference of the whole model, ξ − ξ_r is driven by x − x_r,
and u = [D_c, C_c] (x − x_r, ξ − ξ_r) + u_r. At a set-point the ξ_r of an integral is a ramp.

With an observer the sensor measures (Cx, ξ), and estimates x from Cx as without a controller: so B_c x has to
follow from Cx.
"""

from typing import TypeVar

import numpy as np

from noack.controllers.linear_feedback import LinearFeedbackSettings
from noack.controllers.state_space import StateSpaceSettings
from noack.core.linear_systems import Matrix
from noack.observers.luenberger import LuenbergerSettings
from noack.scenario.loads import COMPARING_ERRORS, padded, with_weight
from noack.scenario.scenario_tables import ScenarioTables
from noack.scenario.sections import AnyObserver, ModelSection, PlantSection, instability
from noack.settings.values import MatrixRows, require_distinct, require_shape, rows_of
from noack.trigger_policies.policy_settings import CombinedSettings

S = TypeVar("S", bound=ScenarioTables)
_ROUNDING = 1e-9
"""What drives the controller is measured up to this share of it."""


def check_controller_states(scenario: ScenarioTables) -> None:
    """Raise ValueError unless the tables fit a controller with states; the message begins with the key."""
    controller = scenario.controller
    if not isinstance(controller, StateSpaceSettings):
        return
    (n, m), k = scenario.model.dimensions, controller.states
    require_shape(
        controller.B,
        "controller.B",
        (k, n),
        "as many rows as controller.A, one column per state of the model",
    )
    require_shape(controller.C, "controller.C", (m, k), "one row per input, as many columns as controller.A")
    require_shape(
        controller.D, "controller.D", (m, n), "one row per input, one column per state of the model"
    )
    kind = f'not with controller.kind = "{controller.kind}"'
    observer, measurement = scenario.observer, scenario.plant.measurement
    if scenario.model.load is not None:
        raise ValueError(f"model.load: {kind}; a load that the model knows needs no integral")
    if measurement.is_noisy:
        raise ValueError(f"plant.measurement: {kind}, whose state is computed from x without noise")
    if observer is not None and not isinstance(observer, LuenbergerSettings):
        raise ValueError(f'observer.kind: {kind}; take "luenberger"')
    C, driving = measurement.matrix(n), np.array(controller.B)
    if observer is not None and np.shape(C)[1] == n:
        rest = driving - driving @ np.linalg.pinv(C) @ C
        if np.abs(rest).max() > _ROUNDING * np.abs(driving).max():
            raise ValueError(
                "controller.B: it drives the controller by states that plant.measurement.C does not have; "
                "take measured ones"
            )
    for index, change in enumerate(scenario.changes):
        if "controller.setpoint" in change.set:
            raise ValueError(f"changes.{index}.set: controller.setpoint: {kind}; give a controller.reference")
    policy = scenario.trigger.rule if isinstance(scenario.trigger, CombinedSettings) else scenario.trigger
    if policy.policy not in COMPARING_ERRORS:
        raise ValueError(
            f'trigger.policy: "{policy.policy}" compares with x, which has no state of the controller; take '
            f"one of {', '.join(COMPARING_ERRORS)}"
        )
    model = controlled_model(scenario.model, controller)
    require_distinct(model.state_names, "model.state_names")
    if not model.allow_unstable and (reason := instability(*model.trigger_matrices)) is not None:
        raise ValueError(
            f"controller.A: with the controller's states, {reason}; to run the unstable loop anyway, set "
            "model.allow_unstable = true"
        )


def with_controller_states(resolved: S) -> S:
    """Return a resolved scenario whose model and plant have the controller's states, too."""
    controller = resolved.controller
    if not isinstance(controller, StateSpaceSettings):
        return resolved
    shared = {key: getattr(controller, key) for key in LinearFeedbackSettings.model_fields if key != "kind"}
    return resolved.model_copy(update={
        "model": controlled_model(resolved.model, controller),
        "plant": _controlled_plant(resolved.plant, controller),
        "observer": _controlled_observer(resolved.observer, controller.states),
        "trigger": with_weight(resolved.trigger, *_weighed(resolved.model, controller)),
        "controller": LinearFeedbackSettings.model_construct(**shared),
    })  # fmt: skip


def controlled_model(model: ModelSection, controller: StateSpaceSettings) -> ModelSection:
    """Return a model with the states (x, ξ) in place of x, and the gain [D_c, C_c]."""
    (A, B, K), k = model.trigger_matrices, controller.states
    D = K if controller.D is None else np.array(controller.D)
    names = ("controller",) if k == 1 else tuple(f"controller_{number + 1}" for number in range(k))
    given = model.state_names or (model.name and model.named.state_names)
    return model.model_copy(update={
        "name": None, "parameters": {}, "A": rows_of(_with_states(A, controller)),
        "B": rows_of(np.pad(B, ((0, k), (0, 0)))), "gain": rows_of(np.hstack([D, np.array(controller.C)])),
        "state_names": (*given, *names) if given else None,
        "state_units": model.state_units and (*model.state_units, *("",) * k), "controller_states": k,
    })  # fmt: skip


def _controlled_plant(plant: PlantSection, controller: StateSpaceSettings) -> PlantSection:
    k = controller.states
    update: dict[str, object] = {
        "initial_state": (*plant.initial_state, *(0.0,) * k),
        "disturbances": tuple(padded(each, k) for each in plant.disturbances),
        "measurement": plant.measurement.model_copy(update={"C": _measured(plant, k)}),
    }
    if plant.A is not None and plant.B is not None:
        update["A"] = rows_of(_with_states(np.array(plant.A), controller))
        update["B"] = rows_of(np.pad(np.array(plant.B), ((0, k), (0, 0))))
    for key, columns in (("uncertainty_A", k), ("uncertainty_B", 0)):
        if (halfwidths := getattr(plant, key)) is not None:
            update[key] = rows_of(np.pad(np.array(halfwidths), ((0, k), (0, columns))))
    return plant.model_copy(update=update)


def _measured(plant: PlantSection, k: int) -> MatrixRows | None:
    """Return the rows of (Cx, ξ); None: all states are measured."""
    C = plant.measurement.C
    return None if C is None else _diagonal(np.array(C), np.eye(k))


def _controlled_observer(observer: AnyObserver | None, k: int) -> AnyObserver | None:
    """Return an observer of x, resolved, for (x, ξ) with ξ as it is measured."""
    if not isinstance(observer, LuenbergerSettings):
        return observer
    gains = {name: getattr(observer, name) for name in ("gain", "first_gain")}
    update: dict[str, object] = {
        name: _diagonal(np.array(rows), np.eye(k)) for name, rows in gains.items() if rows is not None
    }
    if observer.initial_estimate is not None:
        update["initial_estimate"] = (*observer.initial_estimate, *(0.0,) * k)
    return observer.model_copy(update=update)


def _diagonal(first: Matrix, second: Matrix) -> MatrixRows:
    zeros = np.zeros((len(first), len(second.T)))
    return rows_of(np.block([[first, zeros], [np.zeros((len(second), len(first.T))), second]]))


def _with_states(A: Matrix, controller: StateSpaceSettings) -> Matrix:
    return np.block([
        [A, np.zeros((len(A), controller.states))],
        [np.array(controller.B), np.array(controller.A)],
    ])  # fmt: skip


def _weighed(model: ModelSection, controller: StateSpaceSettings) -> tuple[Matrix, Matrix]:
    """Return A + B D_c, and the effect B C_c of the controller's states on it."""
    A, B, K = model.trigger_matrices
    D = K if controller.D is None else np.array(controller.D)
    return A + B @ D, B @ np.array(controller.C)
