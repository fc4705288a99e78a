"""From a scenario to a run: named models become matrices, drawn quantities become numbers.

The resolved scenario is a scenario again; running it repeats the run's draws exactly.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from noack.errors import CallerError
from noack.linear import Matrix, Vector, discretise
from noack.models import NAMED_MODELS
from noack.rng import stream
from noack.scenario import Model, Scenario

_SURELY_FINITE = 600.0
"""‖e^{At}‖ ≤ e^{‖A‖t}, and e^700 is still a number; beyond, the exponential itself must tell."""


@dataclass(frozen=True)
class Loop:
    """The matrices of a resolved scenario, in the paper's notation (n states, m inputs)."""

    A_model: Matrix
    """Â, (n, n)."""
    B_model: Matrix
    """B̂, (n, m)."""
    K: Matrix
    """Gain, (m, n)."""
    H: Matrix
    """What both models integrate between updates: Â + B̂K, or 0 in zero-order-hold mode, (n, n)."""
    A: Matrix
    """True plant, (n, n)."""
    B: Matrix
    """True plant, (n, m)."""
    x0: Vector
    """x(0), (n,)."""
    weight: Matrix | None
    """W of the trigger's norm, (n, n); None is the identity."""
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.B.T)


def resolve(scenario: Scenario) -> Scenario:
    """Return the scenario with every named or drawn quantity made explicit.

    Raises:
        CallerError: the numbers are so large that one step of the plant or model is not finite.
    """
    model = _explicit_model(scenario.model)
    A, B = np.array(model.A), np.array(model.B)
    (n, m), plant = B.shape, scenario.plant
    x0 = np.array(plant.initial_state)
    if plant.initial_state_halfwidth is not None:
        halfwidth = np.array(plant.initial_state_halfwidth)
        x0 += halfwidth * stream(scenario.seeds.initial_state, "initial_state").uniform(-1, 1, n)
    if plant.draw == "given":
        A, B = np.array(plant.A), np.array(plant.B)
    elif plant.draw in ("uniform", "vertex"):
        rng = stream(scenario.seeds.plant, "plant")
        A = A + _perturbation(rng, plant.draw, plant.uncertainty_A, (n, n))
        B = B + _perturbation(rng, plant.draw, plant.uncertainty_B, (n, m))
    K = np.array(model.gain)
    _require_finite("plant", A, B, scenario.plant_period_ns)
    if scenario.mode == "model":
        H = np.array(model.A) + np.array(model.B) @ K
        _require_finite("model", H, K.T, scenario.controller_period_ns)
    return scenario.model_copy(
        update={
            "model": model,
            "plant": plant.model_copy(
                update={
                    "draw": "given",
                    "A": _rows(A),
                    "B": _rows(B),
                    "initial_state": tuple(x0.tolist()),
                    "initial_state_halfwidth": None,
                }
            ),
        }
    )


def loop_of(resolved: Scenario) -> Loop:
    """Return the matrices of a resolved scenario."""
    model, plant = resolved.model, resolved.plant
    A_model, B_model, K = np.array(model.A), np.array(model.B), np.array(model.gain)
    H = A_model + B_model @ K if resolved.mode == "model" else np.zeros_like(A_model)
    weight = resolved.trigger.weight
    return Loop(
        A_model=A_model,
        B_model=B_model,
        K=K,
        H=H,
        A=np.array(plant.A),
        B=np.array(plant.B),
        x0=np.array(plant.initial_state),
        weight=None if weight is None else np.array(weight),
        state_names=model.state_names or (),
        input_names=model.input_names or (),
    )


def _require_finite(key: str, A: Matrix, B: Matrix, step_ns: int) -> None:
    with np.errstate(all="ignore"):
        if np.linalg.norm(A, 1) * step_ns * 1e-9 < _SURELY_FINITE and np.isfinite(B).all():
            return
        try:
            finite = all(np.isfinite(block).all() for block in discretise(A, B, step_ns))
        except ValueError:  # scipy's word for an exponential of infinite entries
            finite = False
    if not finite:
        raise CallerError(f"{key}: these matrices take one step to infinity; check their size")


def _explicit_model(model: Model) -> Model:
    if model.name is not None:
        named = NAMED_MODELS[model.name](model.parameters)
        return Model(
            A=_rows(named.A),
            B=_rows(named.B),
            gain=model.gain or _rows(named.K),
            state_names=model.state_names or named.state_names,
            input_names=model.input_names or named.input_names,
        )
    n, m = np.array(model.B).shape
    return model.model_copy(
        update={
            "state_names": model.state_names or tuple(f"x_{i + 1}" for i in range(n)),
            "input_names": model.input_names or tuple(f"u_{i + 1}" for i in range(m)),
        }
    )


def _perturbation(
    rng: np.random.Generator,
    draw: Literal["uniform", "vertex"],
    halfwidth: tuple[tuple[float, ...], ...] | None,
    shape: tuple[int, int],
) -> Matrix:
    # Drawn for every entry, so that widening one entry's interval leaves the other draws alone.
    unit = rng.uniform(-1.0, 1.0, shape)
    if draw == "vertex":
        unit = np.where(unit < 0, -1.0, 1.0)
    return np.zeros(shape) if halfwidth is None else np.array(halfwidth) * unit


def _rows(matrix: Matrix) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())
