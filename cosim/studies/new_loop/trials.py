"""The loops that are tried for a plant: gains, rates, limits of consecutive losses, decays of the threshold.

With allowed errors, errors of states count in the trigger's norm by how large the states become. If the
plant has friction, its model is the one beside the friction's step, and the gain is stiff enough for the
friction to take a small share of the allowed errors. Other loops are tried with several limits of
consecutive losses, rates and thresholds, and also with slower gains if the gain is not given.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cosim.studies.new_loop import ALPHA_SHARE, DEFAULT_MANSD
from cosim.studies.new_loop.linear_model import LinearModel, LoopGain, gain
from netem.core.clock import NS_PER_S
from netem.core.errors import CallerError
from netem.core.number_format import to_digits
from noack.core.linear_systems import Matrix, Vector, discretise

DEFAULT_START = 0.1
"""x(0) of a state, if the plant has none."""


@dataclass(frozen=True)
class LoopTrial:
    """A loop with settings that are tried together."""

    gain: LoopGain
    rate_hz: float
    mansd: int
    alpha_per_s: float
    x0: Vector
    weight: Matrix | None = None
    has_friction: bool = False
    """Whether friction keeps the plant from x = 0: then a search takes the longest."""
    floor: float | None = None
    """Last threshold; None: a share of the first one."""
    guaranteed_from_s: float = 0.0
    """When all outputs are guaranteed to stay within their allowed errors."""


def list_trials(
    model: LinearModel | LoopGain, x0: Vector, allowed: Mapping[str, float]
) -> Iterator[LoopTrial]:
    """Yield the trials, the preferred settings first; states without an allowed error may move.

    Raises:
        CallerError: no gain makes the loop fast enough for a simulation of its fastest eigenvalue.
    """
    linear = model.model if isinstance(model, LoopGain) else model
    has_friction = linear.source == "beside"
    gains = [model] if isinstance(model, LoopGain) else _gains(model, x0, allowed)
    slowest_per_s = [_usual_rate_hz(loop_gain) / _MOST_STEPS_PER_TIME_CONSTANT for loop_gain in gains]
    fast = [each for each, slowest in zip(gains, slowest_per_s, strict=True) if each.decay_per_s >= slowest]
    if not fast:
        raise CallerError(
            f"{linear.plant.label}: without errors x decays as e^(−{gains[0].decay_per_s:.3g}t) only, too "
            f"slowly for its fastest eigenvalue: at least e^(−{slowest_per_s[-1]:.3g}t) is needed; choose "
            "a faster gain with noack gain --q or --poles"
        )
    shares = (ALPHA_SHARE / 2,) if has_friction else (ALPHA_SHARE, ALPHA_SHARE / 2)
    fastest_per_s = math.inf if allowed else 1.0  # of α: only allowed errors ask for a fast loop
    for loop_gain in fast:
        weight = _unit_weight(loop_gain, x0, allowed)
        for rate_hz in _rates_hz(loop_gain, has_friction=has_friction):
            for mansd in range(DEFAULT_MANSD, 0, -1):
                for share in shares:
                    alpha_per_s = to_digits(min(share * loop_gain.decay_per_s, fastest_per_s))
                    yield LoopTrial(loop_gain, rate_hz, mansd, alpha_per_s, x0, weight, has_friction)


_INPUT_WEIGHTS = (1.0, 10.0, 100.0)
"""r of the regulators that are tried: with a larger one the gain is slower."""
_FRICTION_INPUT_WEIGHTS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 3e-4, 1e-4)
"""The same with allowed errors and friction, which keeps an output off by its size over the gain."""


def _gains(model: LinearModel, x0: Vector, allowed: Mapping[str, float]) -> list[LoopGain]:
    """Return the gains that are tried; with allowed errors and friction, only stiff enough gains."""
    q = state_weights(model, allowed)
    if not (allowed and model.source == "beside"):
        return [gain(model, q=q, r=r) for r in _INPUT_WEIGHTS]
    gains = [gain(model, q=q, r=input_weights(model, r)) for r in _FRICTION_INPUT_WEIGHTS]
    return [each for each in gains if _sticks_within(each, x0, allowed)] or gains[-1:]


_RATES_HZ = (1.0, 2.0, 5.0, 10.0, 20.0, 25.0, 50.0, 100.0, 200.0, 250.0, 500.0)
"""Rates that are chosen from: their periods are whole milliseconds."""
_STEPS_PER_TIME_CONSTANT = 50
"""Least number of steps of the plant in the time constant of the loop's fastest eigenvalue."""
_MOST_STEPS_PER_TIME_CONSTANT = 1e6
"""Number of steps in the time constant of the slowest loop: each simulation takes minutes."""


def _usual_rate_hz(loop_gain: LoopGain) -> float:
    """Return the plant's own rate, or the lowest one that is high enough for the loop.

    Eigenvalues above 1000 /s do not count: no loop can follow them.
    """
    fastest_per_s = max((size for size in np.abs(loop_gain.eigenvalues) if size < 1000.0), default=1)
    least_hz = _STEPS_PER_TIME_CONSTANT * fastest_per_s
    usual_hz = next((rate_hz for rate_hz in _RATES_HZ if rate_hz >= least_hz), _RATES_HZ[-1])
    return float(loop_gain.model.plant.rates.get("rate_hz", usual_hz))


def _rates_hz(loop_gain: LoopGain, *, has_friction: bool) -> tuple[float, ...]:
    """Return the rates that are tried. Delays cost most with the stiff gain that friction needs."""
    usual_hz = _usual_rate_hz(loop_gain)
    if loop_gain.model.plant.system.has_own_step:
        return (usual_hz,)
    return (2 * usual_hz,) if has_friction else (usual_hz, 2 * usual_hz)


_OTHER_WEIGHT = 0.01
"""Weight of a state without an allowed error in the regulator, where others have one, with weight 1."""


def state_weights(model: LinearModel, allowed: Mapping[str, float]) -> list[float] | None:
    """Return the weights of the states in the regulator; None: all are 1."""
    names = model.plant.state_names
    return [1.0 if name in allowed else _OTHER_WEIGHT for name in names] if allowed else None


_USUAL_INPUT = 20.0
"""The largest entry of a column of B for which these r hold. With another one r is such that the loop is the
same: the unit of an input does not matter."""
_LEAST_EFFECT = 1e-6
"""Smaller effects, relative to the usual one, count as this one: no Riccati equation is solved beyond."""


def input_weights(model: LinearModel, r: float) -> list[float]:
    """Return the weights of the inputs in the regulator, (m,), for one that has the usual effect."""
    effects = np.maximum(np.abs(model.B).max(axis=0) / _USUAL_INPUT, _LEAST_EFFECT)
    return [to_digits(r * effect**2) for effect in effects.tolist()]


_SIZE_STEPS, _SIZE_TIME_CONSTANTS, _LEAST_SIZE = 400, 5.0, 1e-3
"""How long and how finely the linear loop is followed to see how large its states become; the least size
of one, as a share of the largest."""


def largest_sizes(loop: LoopGain, x0: Vector) -> Vector:
    """Return how large states and inputs become in the linear loop from x(0), (n + m,)."""
    A, B = loop.model.A, loop.model.B
    step_ns = round(_SIZE_TIME_CONSTANTS / loop.decay_per_s / _SIZE_STEPS * NS_PER_S)
    step, _ = discretise(A + B @ loop.K, np.zeros_like(B), max(step_ns, 1))
    x, largest = x0 if x0.any() else np.full(len(x0), DEFAULT_START), np.zeros(len(A) + B.shape[1])
    for _ in range(_SIZE_STEPS):
        largest = np.maximum(largest, np.abs(np.concatenate([x, loop.K @ x])))
        x = step @ x
    return np.maximum(largest, _LEAST_SIZE * float(largest.max()))


_STICKING_SHARE = 0.25
"""Of an allowed error, friction takes at most this, if a gain is stiff enough."""


def _sticks_within(loop: LoopGain, x0: Vector, allowed: Mapping[str, float]) -> bool:
    """Return whether friction keeps each allowed state off by a small share of its allowed error.

    Where the model is beside a step of a plant's derivative, the rest of the derivative is v, the same near
    and far. Against it the loop rests at (A + BK)⁻¹ v.
    """
    model, sizes = loop.model, largest_sizes(loop, x0)[: len(x0)]
    rates = getattr(model.plant.system_at(np.zeros_like(x0)), "rates", None)
    assert rates is not None  # a model beside a step is one of a derivative
    left_out, u = np.zeros_like(x0), np.zeros(model.B.shape[1])
    for size, x in zip(sizes, np.eye(len(x0)), strict=True):
        rests = [np.abs(rates(share * size * x, u) - model.A @ (share * size * x)) for share in (0.5, 1.0)]
        left_out += np.minimum(*rests)
    off = np.abs(np.linalg.inv(model.A + model.B @ loop.K)) @ left_out
    names = model.plant.state_names
    return all(off[names.index(name)] <= _STICKING_SHARE * error for name, error in allowed.items())


def _unit_weight(loop: LoopGain, x0: Vector, allowed: Mapping[str, float]) -> Matrix | None:
    """Return W of the trigger's norm, in units of the first allowed state; None without one.

    Errors of different units count by how large their states become.
    """
    if not allowed:
        return None
    sizes, names = largest_sizes(loop, x0)[: len(x0)], loop.model.plant.state_names
    first = sizes[names.index(next(iter(allowed)))]
    return np.diag([to_digits(first / size, 2) for size in sizes])
