"""Unknown constant loads as states of the model: no steady-state error, nothing sent while they last.

The plant is ẋ = Ax + Bu + E d with a constant d, k loads that nobody measures. The model of sensor and
controller has the states (x, d), with ḋ = 0. The sensor's observer estimates both, an update carries
both, and the input is u = Kx + K_d d. The loop stays linear, so what holds for a model of n states
holds for this one of n + k.

K_d solves the regulator equations (Francis, SIAM J. Control Optim. 15(3), 1977)

    A Π + B Γ + E = 0,  S Π = 0,  K_d = Γ − K Π,

where S selects the states that stay at 0. Under the load, the closed loop rests at x = Π d. A load at
the input, E = B, has Γ = −I and Π = 0: u = Kx − d, and every state goes to 0.

A resolved scenario has the loads in its matrices, at the end of the plant's state, too.
"""

import math
from typing import NamedTuple, TypeVar

import numpy as np

from netem.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa, transition
from noack.disturbances.disturbance_settings import DisturbanceSettings
from noack.disturbances.step import StepDisturbance
from noack.observers.luenberger import LuenbergerSettings
from noack.observers.observer_settings import NoiseVariances, observer_gain, unobservable_mode
from noack.scenario.scenario_tables import ScenarioTables
from noack.scenario.sections import AnyObserver, ModelSection, PlantSection
from noack.settings.values import require_distinct, require_length, rows_of
from noack.trigger_policies.policy_settings import CombinedSettings, PolicySettings, WeightedSettings

S = TypeVar("S", bound=ScenarioTables)
_ROUNDING = 1e-9
"""Largest share of the load's effect that the solved regulator equations may leave."""
_OBSERVER_SPEED = 4.0
"""How much faster than the slowest pole of A + BK an observer without settings is."""
COMPARING_ERRORS = ("absolute", "deadline", "decaying", "dwell", "periodic", "python", "send_on_area")
"""Policies that compare x_s − x, or times, only: a load is not small like a state."""


class LoadGains(NamedTuple):
    """The solved regulator equations."""

    E: Matrix  # Effect of the loads on ẋ, (n, k)
    gain: Matrix  # K_d, (m, k)
    rest: Matrix  # Π, (n, k): the closed loop rests at Π d


def load_gains(model: ModelSection) -> LoadGains:
    """Return what follows from the loads of a model that is not resolved.

    Raises:
        ValueError: the input cannot hold the states against the load; the message begins with the key.
    """
    A, B, K = model.trigger_matrices
    (n, m), load = B.shape, model.load
    if load == "input":
        return LoadGains(B, -np.eye(m), np.zeros((n, m)))
    E, held = np.array(load), np.eye(n)
    if model.hold is not None:
        names = list(model.state_names or model.named.state_names)
        held = held[[names.index(name) for name in model.hold]]
    size = max(float(np.abs(E).max()), np.finfo(float).tiny)
    equations = np.block([[A, B], [held, np.zeros((len(held), m))]])
    solved = np.linalg.lstsq(equations, np.vstack([-E, np.zeros((len(held), E.shape[1]))]), rcond=1e-14)[0]
    rest, forward = solved[:n], solved[n:]
    if np.abs(A @ rest + B @ forward + E).max() > _ROUNDING * size or (
        np.abs(held @ rest).max() > _ROUNDING * max(float(np.abs(rest).max()), 1.0)
    ):
        raise ValueError(_not_held(model, m))
    return LoadGains(E, forward - K @ rest, rest)


def _not_held(model: ModelSection, m: int) -> str:
    most = "one state" if m == 1 else f"{m} states"
    if model.hold is None:
        return (
            "model.load: the input cannot cancel this load in every state; name in model.hold the states "
            f"that are to stay at 0, {most} at most"
        )
    return (
        f"model.hold: no constant input holds {', '.join(model.hold)} at 0 under the load; name other "
        f"states, {most} at most"
    )


def check_loads(scenario: ScenarioTables) -> None:
    """Raise ValueError unless the tables fit the model's loads; the message begins with the key."""
    model, plant, k = scenario.model, scenario.plant, scenario.model.loads
    if model.load is None:
        for key in ("load", "load_halfwidth", "load_changes"):
            if getattr(plant, key):
                raise ValueError(f'plant.{key}: the model has no load; give model.load, e.g. "input"')
        return
    for key in ("load", "load_halfwidth"):
        require_length(getattr(plant, key), f"plant.{key}", k, "one per load")
    _check_changes(scenario)
    load_gains(model)
    policy = scenario.trigger.rule if isinstance(scenario.trigger, CombinedSettings) else scenario.trigger
    if policy.policy not in COMPARING_ERRORS:
        raise ValueError(
            f'trigger.policy: "{policy.policy}" compares with ‖x‖, and a load is not small; with model.load '
            f"take one of {', '.join(COMPARING_ERRORS)}"
        )
    if not scenario.controller.is_linear:
        raise ValueError(
            f'model.load: u = Kx + K_d d; not with controller.kind = "{scenario.controller.kind}"'
        )


def _check_changes(scenario: ScenarioTables) -> None:
    plant, last_s = scenario.plant, 0.0
    if plant.load_changes and not scenario.coverage.is_linear:
        raise ValueError(
            "plant.load_changes: needs a linear plant; disturb this one: "
            '{ kind = "step", at = "input", amplitude = …, from_s = … }'
        )
    for number, change in enumerate(plant.load_changes):
        place = f"plant.load_changes.{number}"
        require_length(change.load, f"{place}.load", scenario.model.loads, "one per load")
        if change.at_s < last_s:
            raise ValueError(f"{place}.at_s: earlier than the change before it")
        last_s = change.at_s
    if scenario.model.load is not None:
        require_distinct(loaded_model(scenario.model).state_names, "model.state_names")
    if plant.load and not scenario.coverage.is_linear and scenario.model.load != "input":
        raise ValueError('plant.load: a plant that is not linear can have it with model.load = "input" only')


def noise_with_loads(scenario: ScenarioTables) -> NoiseVariances:
    """Return the variances of a scenario's noise for the model's states; those of loads are 0."""
    model, (_, m) = scenario.model, scenario.model.dimensions
    noise = scenario.plant.noise_variances(model.dimensions[0], m)
    at_state = np.zeros(model.states)
    at_state[: len(noise.at_state)] = noise.at_state
    return noise._replace(at_state=at_state)


def loaded_model(model: ModelSection) -> ModelSection:
    """Return a model that has loads with the states (x, d) in place of x."""
    (A, B, K), (E, gain, _), k = model.trigger_matrices, load_gains(model), model.loads
    names = ("load",) if k == 1 else tuple(f"load_{number + 1}" for number in range(k))
    return model.model_copy(update={
        "A": rows_of(_with_loads(A, E)), "B": rows_of(_below(B, k)), "gain": rows_of(np.hstack([K, gain])),
        "state_names": (*(model.state_names or ()), *names),
        "state_units": model.state_units and (*model.state_units, *("",) * k),
        "load": None, "hold": None, "load_states": k,
    })  # fmt: skip


def loaded_plant(scenario: S, plant: PlantSection, load: Vector) -> PlantSection:
    """Return a resolved plant with the states (x, d).

    Args:
        scenario: with the model as it was given.
        plant: its plant, resolved without loads.
        load: the true loads at time 0, (k,).
    """
    model, k = scenario.model, len(load)
    n, E = model.dimensions[0], load_gains(model).E
    update: dict[str, object] = {
        "initial_state": (*plant.initial_state, *load.tolist()),
        "load": None, "load_halfwidth": None, "load_changes": (),
        "disturbances": (*(padded(each, k) for each in plant.disturbances), *_steps(scenario, load)),
    }  # fmt: skip
    C = np.hstack([plant.measurement.matrix(n), np.zeros((plant.measurement.outputs(n), k))])
    update["measurement"] = plant.measurement.model_copy(update={"C": rows_of(C)})
    if plant.A is not None and plant.B is not None:
        A, B = np.array(plant.A), np.array(plant.B)
        update["A"] = rows_of(_with_loads(A, B if model.load == "input" else E))
        update["B"] = rows_of(_below(B, k))
    for key, columns in (("uncertainty_A", k), ("uncertainty_B", 0)):
        if (halfwidths := getattr(plant, key)) is not None:
            update[key] = rows_of(np.pad(np.array(halfwidths), ((0, k), (0, columns))))
    if model.load == "input" and plant.uncertainty_B is not None:  # the loads enter as the inputs do
        box = np.zeros((n + k, n + k))
        if plant.uncertainty_A is not None:
            box[:n, :n] = plant.uncertainty_A
        box[:n, n:] = plant.uncertainty_B
        update["uncertainty_A"] = rows_of(box)
    return plant.model_copy(update=update)


def _steps(scenario: ScenarioTables, load: Vector) -> list[StepDisturbance]:
    """Return the changes of the load as disturbances of ḋ, each during one step of the plant."""
    step_s, n, steps = scenario.timing.plant_period_ns * 1e-9, scenario.model.dimensions[0], []
    for change in scenario.plant.load_changes:
        rate_per_s = (np.array(change.load) - load) / step_s
        amplitude = (*np.zeros(n).tolist(), *rate_per_s.tolist())
        first_s = np.ceil(change.at_s / step_s - 1e-6) * step_s
        around_s = {"from_s": max(first_s - step_s / 2, 0.0), "until_s": first_s + step_s / 2}
        steps.append(StepDisturbance(kind="step", at="state", amplitude=amplitude, **around_s))
        load = np.array(change.load)
    return steps


def first_load_change_s(resolved: ScenarioTables) -> float:
    """Return when the loads of a resolved scenario first change; infinite if they do not."""
    return min((change.from_s for change in _load_changes(resolved)), default=math.inf)


def with_constant_load(resolved: S) -> S:
    """Return a resolved scenario whose loads stay those of time 0."""
    changes = _load_changes(resolved)
    if not changes:
        return resolved
    kept = tuple(each for each in resolved.plant.disturbances if each not in changes)
    return resolved.model_copy(update={"plant": resolved.plant.model_copy(update={"disturbances": kept})})


def _load_changes(resolved: ScenarioTables) -> list[StepDisturbance]:
    n = len(resolved.model.A or ()) - resolved.model.load_states
    return [
        each for each in resolved.plant.disturbances
        if isinstance(each, StepDisturbance) and each.at == "state" and any(each.amplitude[n:])
    ]  # fmt: skip


def padded(disturbance: DisturbanceSettings, k: int) -> DisturbanceSettings:
    """Return a disturbance with zeros for k further states, if it is one of the state."""
    if disturbance.at != "state":
        return disturbance
    return disturbance.model_copy(update={disturbance.entries_key: (*disturbance.entries, *(0.0,) * k)})


def loaded_trigger(model: ModelSection, trigger: PolicySettings) -> PolicySettings:
    """Return a trigger with a weight of the loads, too.

    The weight of a load is the distance, in the trigger's norm, at which the closed loop rests if
    the load is 1 and the model has 0: so an error of the load counts as the offset that it causes.
    """
    A, B, K = model.trigger_matrices
    return with_weight(trigger, A + B @ K, load_gains(model).E)


def with_weight(trigger: PolicySettings, closed_loop: Matrix, effect: Matrix) -> PolicySettings:
    """Return a trigger whose weight has k more states, by the offsets that they cause.

    Args:
        trigger: for n states.
        closed_loop: M in dx/dt = Mx + effect·d, (n, n).
        effect: of the further states d on dx/dt, (n, k).
    """
    if isinstance(trigger, CombinedSettings):
        return trigger.model_copy(update={"rule": with_weight(trigger.rule, closed_loop, effect)})
    if not isinstance(trigger, WeightedSettings):
        return trigger
    W = np.eye(len(closed_loop)) if trigger.weight is None else np.array(trigger.weight)
    offsets = np.linalg.norm(W @ np.linalg.lstsq(closed_loop, effect, rcond=None)[0], axis=0)
    return trigger.model_copy(update={"weight": rows_of(_diagonal(W, np.diag(np.maximum(offsets, 1e-12))))})


def loaded_observer(resolved: ScenarioTables) -> AnyObserver:
    """Return the observer of a resolved scenario with loads; without settings, a usual one.

    Raises:
        CallerError: the loads do not appear in what is measured.
    """
    model, observer, n = resolved.model, resolved.observer, resolved.model.plant_states
    A, C = np.array(model.A), resolved.plant.measurement.matrix(len(model.A or ()))
    period_ns = float(resolved.timing.measurement_period.exact)
    step = transition(A, period_ns)
    if unobservable_mode(step, C) is not None:
        raise CallerError(f"model.load: {_not_estimated(step, C, n)}")
    if observer is None:
        observer = LuenbergerSettings(kind="luenberger", gain=rows_of(_usual_gain(resolved, step, C)))
    elif observer.initial_estimate is not None and len(observer.initial_estimate) == n:
        loads = (0.0,) * model.load_states
        observer = observer.model_copy(update={"initial_estimate": (*observer.initial_estimate, *loads)})
    observer = observer.resolved(step, C, period_ns)
    is_unknown = resolved.network.initial_sync == "first_packet" and observer.initial_estimate is None
    if isinstance(observer, LuenbergerSettings) and observer.first_gain is None and is_unknown:
        first = np.zeros((len(A), len(C)))  # of what is measured first, nothing is a load
        first[:n] = np.linalg.pinv(C[:, :n])
        observer = observer.model_copy(update={"first_gain": rows_of(first)})
    return observer


def _not_estimated(step: Matrix, C: Matrix, n: int) -> str:
    """Return why no observer estimates the loads, which are the states after the first n, and what to do."""
    if unobservable_mode(step[:n, :n], C[:, :n]) is not None:
        return (
            "plant.measurement.C does not determine the model's states, so no load can be estimated; "
            "measure more states, or leave model.load out"
        )
    alone = [np.ix_([*range(n), load], [*range(n), load]) for load in range(n, len(step))]
    if all(unobservable_mode(step[each], C[:, each[1][0]]) is not None for each in alone):
        which = "this load" if len(alone) == 1 else "none of these loads"
        can = "cannot" if len(alone) == 1 else "can"
        return (
            f"{which} {can} be estimated from what plant.measurement.C measures; measure more states, "
            "or leave model.load out"
        )
    return (
        "the observer cannot tell the loads apart from what plant.measurement.C measures; "
        f"measure more states, or take fewer loads than {len(alone)}"
    )


def _usual_gain(resolved: ScenarioTables, step: Matrix, C: Matrix) -> Matrix:
    """Return L of an observer without settings, (n + k, p).

    If all states are measured without noise, x̂ is what is measured, and the error of the loads decays
    at a rate λ: the innovation is E_d times this error, E_d the loads' effect between measurements.
    Otherwise its poles are λ and a little faster, but those of the model that are faster than λ.
    """
    model, n, k = resolved.model, resolved.model.plant_states, resolved.model.load_states
    A, B, K = model.trigger_matrices
    closed_loop = A[:n, :n] + B[:n] @ K[:, :n]
    rate_per_s = _OBSERVER_SPEED * -spectral_abscissa(closed_loop)
    period_s = float(resolved.timing.measurement_period.exact) * 1e-9
    measurement = resolved.plant.measurement
    if not measurement.is_noisy and np.array_equal(C, np.eye(n, n + k)):
        share = -np.expm1(-rate_per_s * period_s)
        return np.vstack([np.eye(n), share * np.linalg.pinv(step[:n, n:])])
    kept = [pole for pole in np.linalg.eigvals(A[:n, :n]) if pole.real < -rate_per_s]
    others = n + k - len(kept)
    poles = [*kept, *(-rate_per_s * (1 + 0.1 * number) for number in range(others))]
    try:
        return observer_gain(step, C, tuple(complex(np.exp(pole * period_s)) for pole in poles))
    except ValueError as error:
        raise CallerError(
            f"model.load: the usual observer cannot be placed ({error}); give [observer]"
        ) from None


def _with_loads(A: Matrix, E: Matrix) -> Matrix:
    k = E.shape[1]
    return np.block([[A, E], [np.zeros((k, len(A) + k))]])


def _below(B: Matrix, k: int) -> Matrix:
    return np.vstack([B, np.zeros((k, B.shape[1]))])


def _diagonal(A: Matrix, B: Matrix) -> Matrix:
    zeros = np.zeros((len(A), len(B)))
    return np.block([[A, zeros], [zeros.T, B]])
