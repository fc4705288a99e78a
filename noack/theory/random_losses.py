"""Bounds of a loop without a limit on consecutive losses: moments instead of worst cases.

Each update is lost with a probability of at most p̄, whatever happened before. |v| is the r-th
moment norm, (E‖v‖ʳ)^{1/r}, r = 1 or 2, and ρ = p̄^{1/r}. With all signals scaled by e^{αt}, at every
fixed time

    |C e_c| ≤ ‖C W⁻¹‖ a + f_C(a, m, π) + ρ ℓ_C(a, m, π)          (I1): in flight, and lost
    |C x|   ≤ free_C + gain_C π
    π = |p| ≤ |K e_c| + σ (|KH x| + |KH e_c|) + r(σ) (|x|_W + |e_c|_W)
    a = |e_s|_W ≤ ḡβ + I_E m + I_B π,    m = |R_E x|

A missing event's part of e_c is what E x and B p have added since the event before it. So all lost
events together contribute at most ρ (∫‖C e^{(H+αI)s} L_E‖ ds m + ∫‖C e^{(H+αI)s} B U‖ ds π). If
the trigger is tested every h, they contribute at most ρ a Σ_j sup_{τ≥jh} ‖C e^{(H+αI)τ} W⁻¹‖, too.
The inequalities are linear; their solution bounds every moment if their spectral radius is below 1.

At an event of the continuous trigger, where ‖e_s‖_W = β, the number of missing events is known in
distribution, and (I1) gives a bound by itself: :func:`moment_at_events`.
"""

from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Vector
from noack.impairments.loss_process import LossProcess
from noack.theory.certificate_terms import NetworkConditions, VoidError
from noack.theory.enclosure import response, response_until
from noack.theory.error_gains import ErrorGains, Output
from noack.theory.kernel_bounds import KernelBounds, NotDecayingError
from noack.theory.nonnegative_system import solve_inequalities
from noack.theory.plant_gains import PlantGains

_TERMS = 1024
_CELLS = 64
_A, _PI, _ONE = np.eye(3)
"""a, π and 1; every other signal is bounded by a combination of them."""


class Moments(NamedTuple):
    """Bounds of (E‖·‖ʳ)^{1/r}, each multiplied by e^{−rate·t}, at every fixed time t."""

    order: int
    """r."""
    rate_per_s: float
    sensor_error: float
    """Of ‖e_s‖_W."""
    controller_error: float
    """Of ‖e_c‖_W."""
    input_error: float
    """Of ‖u − Kx‖, from the first applied input on."""
    state: float
    """Of ‖x‖."""
    loop_gain: float
    """Spectral radius of the inequalities; below 1."""


def moment_at_events(error: ErrorGains, losses: LossProcess, spacing_s: float, order: int) -> float:
    """Bound (E(‖e_c‖_W e^{αt}/β)ʳ)^{1/r} just before an event of the continuous trigger.

    It is Σ_{j≥0} P(the last j updates are lost)^{1/r} sup_{τ≥jδ}‖e^{(H+αI)τ}‖_W. In a norm in
    which the models contract it is at most 1/(1 − p^{1/r}) for independent losses.

    Args:
        error: the gains of the models.
        losses: the losses.
        spacing_s: δ, a lower bound of the inter-event time; 0 is always valid.
        order: r.

    Raises:
        VoidError: the probability of long bursts does not fall.
        NotDecayingError: α is not below the decay rate of e^{Hτ}.
    """
    tails, longest = losses.tails(_TERMS)
    if not longest < 1:
        raise VoidError("bursts of losses may be arbitrarily long")
    gains = error.kernels[Output.WEIGHTED].sups(spacing_s * np.arange(1.0, _TERMS + 1))
    powers, ratio = tails ** (1 / order), longest ** (1 / order)
    beyond = gains[-1] * powers.sum() * ratio / (1 - ratio)  # a burst of N + j: longest · tails[j]
    return float(1.0 + powers @ gains + beyond)


def moments(
    error: ErrorGains,
    plant: PlantGains,
    conditions: NetworkConditions,
    beta: float,
    largest_probability: float,
    order: int,
) -> Moments:
    """Bound the moments of all signals at every fixed time; ``conditions.dropouts`` has no effect.

    Args:
        error: the gains of the models.
        plant: the gains of the plant.
        conditions: of the schedule.
        beta: β: after a test, ‖e_s‖_W ≤ βe^{−αt}.
        largest_probability: p̄, the largest probability of a loss, given the past.
        order: r.

    Raises:
        VoidError: the spectral radius of the inequalities is not below 1.
        NotDecayingError: α is not below the decay rate of the models, or of A + BK.
    """
    share = largest_probability ** (1 / order)
    ways = (False, True) if conditions.spacing_s > 0 else (False,)
    solved = [
        _Inequalities(error, plant, conditions, beta, share, by_tests=by).solve() for by in ways
    ]
    best = min(solved, key=lambda one: one.get("state", np.inf))
    if "state" not in best:
        gain = min(one["loop_gain"] for one in solved)
        raise VoidError(f"the loop gain of the moments is {gain:.3g}, not below 1")
    return Moments(order=order, rate_per_s=error.alpha_per_s, **best)


class _Inequalities:
    """The inequalities; every signal is bounded by a row: multiples of a and π, and a constant.

    ``share`` is ρ. ``by_tests``: count a lost event at every test; else the drive since the last.
    """

    def __init__(
        self, error: ErrorGains, plant: PlantGains, conditions: NetworkConditions, beta: float,
        share: float, *, by_tests: bool,
    ) -> None:  # fmt: skip
        self._error, self._plant, self._conditions = error, plant, conditions
        self._beta, self._share, self._by_tests = beta, share, by_tests
        self._start_error, self._start = plant.start_up(conditions.start_s)
        if not by_tests:
            if not error.scaled_H.any():
                raise NotDecayingError("a hold does not decay")
            columns = plant.split_mismatch[0], plant.input_matrix
            self._all_drive = [response(error.scaled_H, D) for D in columns]
        if conditions.delay_s > 0:
            columns = plant.split_mismatch[0], plant.input_matrix
            self._recent_drive = [
                response_until(error.scaled_H, D, conditions.delay_s) for D in columns
            ]

    def solve(self) -> dict[str, float]:
        """Return the bounds by the names of ``Moments``; only the loop gain if there are none."""
        conditions, error = self._conditions, self._error
        remainder = error.hold_remainder(conditions.hold_s)
        controller = {output: self._controller_error(output) for output in error.outputs}
        pi = controller[Output.GAIN] + remainder * (
            self._state(Output.WEIGHTED) + controller[Output.WEIGHTED]
        )
        pi += conditions.hold_s * (self._state(Output.GAIN_RATE) + controller[Output.GAIN_RATE])
        a = self._beta * error.stretch(conditions.sampling_s) * _ONE
        if conditions.sampling_s > 0:
            growth = self._plant.growth(conditions.sampling_s, _CELLS)
            a = a + growth.mismatch.integral_on_grid() * self._state(Output.MISMATCH)
            a += growth.input_error.integral_on_grid() * self._input
        rows = np.array([a, pi])
        found = solve_inequalities(rows[:, :2], rows[:, 2])
        if found.bound is None:
            return {"loop_gain": found.loop_gain}
        values = np.append(found.bound, 1.0)
        return {
            "sensor_error": float(values[0]),
            "controller_error": float(controller[Output.WEIGHTED] @ values),
            "input_error": float(values[1]),
            "state": float(self._state(Output.STATE) @ values),
            "loop_gain": found.loop_gain,
        }

    @property
    def _input(self) -> Vector:
        """The bound of |p|, before the first input of the controller, too."""
        return _PI + self._start_error * _ONE

    def _state(self, output: Output) -> Vector:
        free, gain = self._plant.states[output]
        return np.asarray(gain * _PI + (free + self._start[output]) * _ONE)

    def _controller_error(self, output: Output) -> Vector:
        """The bound of |C e_c|: the present error, updates in flight, lost updates."""
        error, C, delay_s = self._error, self._error.outputs[output], self._conditions.delay_s
        drives, found = (self._state(Output.MISMATCH), self._input), error.now(output) * _A
        recent = [0.0, 0.0]
        if delay_s > 0:
            recent = [one.through(C).integral_on_grid() for one in self._recent_drive]
            found = found + error.kernels[output].sup(delay_s) * _A
        for drive, area in zip(drives, recent, strict=True):
            found = found + (1.0 if self._by_tests else 1 - self._share) * area * drive
        if self._by_tests:
            return (
                found
                + self._share
                * _sum_of_sups(error.kernels[output], delay_s, self._conditions.spacing_s)
                * _A
            )
        for drive, kernel in zip(drives, self._all_drive, strict=True):
            found = found + self._share * kernel.through(C).integral() * drive
        return found


def _sum_of_sups(kernel: KernelBounds, first_s: float, spacing_s: float) -> float:
    """Bound Σ_{j≥0} sup k(τ) over τ ≥ first + j·spacing."""
    sups = kernel.sups(first_s + spacing_s * np.arange(_TERMS, dtype=np.float64))
    last_s = first_s + spacing_s * (_TERMS - 1)
    if kernel.tail_rate_per_s == 0:
        return np.inf
    # The sups fall: from the last one on, their sum is at most their integral over the spacing.
    longer_s = max(float(kernel.edges_s[-1]) - last_s, 0.0) + 1 / kernel.tail_rate_per_s
    return float(sups.sum() + sups[-1] * longer_s / spacing_s)
