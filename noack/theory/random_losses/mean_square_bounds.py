"""Mean squares at every fixed time, without a limit on consecutive losses.

Each update is lost with a probability of at most p̄, whatever happened before. |v| is the root mean
square, √(E‖v‖²), and ρ = √p̄. With all signals scaled by e^{αt}, at every fixed time

    |C e_c| ≤ ‖C W⁻¹‖ a + f_C(a, m, π) + ℓ_C(m, π)            (I1): in flight, and lost
    |C x|   ≤ free_C + gain_C π
    π = |p| ≤ |K e_c| + σ (|KH x| + |KH e_c|) + r(σ) (|x|_W + |e_c|_W)
    a = |e_s|_W ≤ ḡβ + I_E m + I_B π,    m = |R_E x|

A missing event's part of e_c is what E x and B p have added since the event before it. All that has
ever been added is D_C = ∫‖C e^{(H+αI)s} L_E‖ ds m + ∫‖C e^{(H+αI)s} B U‖ ds π, so ℓ_C ≤ ρ D_C. But
an event has no more than c_i = β sup ‖C e^{(H+αI)τ} W⁻¹‖, and what is added to it after the last
test, if there have been i − 1 more since; and all i are lost with a probability of at most p̄ⁱ. So
their sum is at most S_J = c_1 + … + c_J, where J is like a random number with P(J ≥ i) ≤ min(1,
p̄ⁱ D_C/c_i):

    ℓ_C ≤ √(Σ_i (S_i² − S_{i−1}²) min(1, p̄ⁱ D_C/c_i)) + ρ/(1 − ρ) √(h d_C D_C)

d_C the rate at which C e_c can grow; the last term is 0 without a period h of tests. This is
concave: any tangent bounds it, and then the inequalities are linear. Without h and delay there is a
bound for every p̄ < 1.

The bounds are made smaller afterwards, by quadratic functions of the loop's state
(:mod:`~noack.theory.random_losses.stochastic_lyapunov`), which need bounds of ‖e_s‖ and of what the
input's age does to p: a first bound is that of the inequalities, and each one makes others smaller.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from noack.core.linear_systems import Vector, exponential
from noack.core.number_format import apart_from
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError
from noack.theory.bounds.enclosure import NotDecayingError, response, response_until
from noack.theory.bounds.gains import ErrorGains, Output, PlantGains
from noack.theory.bounds.stacked_norms import Stack
from noack.theory.certificates.inequalities import solve_inequalities
from noack.theory.random_losses.stochastic_lyapunov import (
    KnownRms,
    LossyFlow,
    QuadraticFunction,
    quadratic_functions,
)

_CELLS = 64
"""Cells of the time between two tests."""
_MOST_LOST = 256
"""Lost events whose parts are bounded one by one; what is beyond is bounded by a geometric sum."""
_FIRST = 1e6
"""Values of a and π, in β, at which the concave terms are replaced by tangents first: far above any."""
_MOST_ROUNDS, _SETTLED = 30, 0.999
"""Rounds of tangents, and of functions; they end where the bound of x falls by less than this factor."""
_A, _PI, _ONE = np.eye(3)
"""a, π and 1; every other signal is bounded by a combination of them."""
_Term = TypeVar("_Term", float, Vector)


class _SignalRows(NamedTuple):
    """Rows that bound signals."""

    mismatch: Vector
    """Of R_E x."""
    input_error: Vector
    """Of p."""


class RootMeanSquares(NamedTuple):
    """Bounds of √(E‖·‖²), each multiplied by e^{−rate·t}, at every fixed time t."""

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


def root_mean_squares(
    error: ErrorGains,
    plant: PlantGains,
    conditions: NetworkConditions,
    beta: float,
    largest_probability: float,
    *,
    refined: bool = False,
) -> RootMeanSquares:
    """Bound all signals at every fixed time; ``conditions.dropouts`` has no effect.

    Args:
        error: the gains of the models.
        plant: the gains of the plant.
        conditions: conditions of the schedule.
        beta: β: after a test, ‖e_s‖_W ≤ βe^{−αt}.
        largest_probability: p̄, the largest probability of a loss, given the past.
        refined: whether to make the bounds smaller by quadratic functions, which takes longer.

    Raises:
        NoCertificateError: the spectral radius of the inequalities is not below 1.
        NotDecayingError: α is not below the decay rate of the models, or of A + BK.
    """
    try:
        inequalities = _MomentInequalities(error, plant, conditions, beta, largest_probability)
        bounds, loop_gain = inequalities.solve()
    except (np.linalg.LinAlgError, OverflowError):
        raise NoCertificateError("numbers overflow: an input is too old for the fastest mode") from None
    if bounds is None:
        raise NoCertificateError(
            f"the loop gain of the mean squares is {apart_from(1, loop_gain)}, not below 1"
        )
    if refined:
        bounds = inequalities.refine(bounds)
    e_c, x = bounds.errors[Output.WEIGHTED], bounds.states[Output.STATE]
    return RootMeanSquares(error.alpha_per_s, bounds.sensor_error, e_c, bounds.input_error, x, loop_gain)


class _Bounds(NamedTuple):
    """Root mean squares that hold already."""

    states: Mapping[str, float]
    """Of ‖C x‖."""
    errors: Mapping[str, float]
    """Of ‖C e_c‖."""
    sensor_error: float
    input_error: float
    """From the first applied input on."""

    @property
    def values(self) -> Vector:
        """Those of a, π and 1."""
        return np.array([self.sensor_error, self.input_error, 1.0])


class _MomentInequalities:
    """The inequalities; every signal is bounded by a row: multiples of a and π, and a constant."""

    def __init__(
        self,
        error: ErrorGains,
        plant: PlantGains,
        conditions: NetworkConditions,
        beta: float,
        probability: float,
    ) -> None:
        if not error.scaled_H.any():
            raise NotDecayingError("a hold does not decay")
        self._error, self._plant, self._conditions = error, plant, conditions
        self._beta, self._probability = beta, probability
        self._start_error, self._start = plant.start_up(conditions.start_s)
        columns, delay_s = (plant.split_mismatch[0], plant.input_matrix), conditions.delay_s
        self._drive = [response(error.scaled_H, D) for D in columns]
        self._recent = [response_until(error.scaled_H, D, delay_s) for D in columns if delay_s > 0]
        self._ages = error.age_gains(conditions.hold_s)
        self._signals = _SignalRows(self._state(Output.MISMATCH), _PI + self._start_error * _ONE)
        self._missing = {str(output): self._missing_events(output, self._signals) for output in error.outputs}

    def solve(self) -> tuple[_Bounds | None, float]:
        """Return bounds, if there are any, and the loop gain.

        Each round bounds the concave terms by their tangents at the bounds that hold already.
        """
        bounds: _Bounds | None = None
        values, loop_gain = np.array([*(_FIRST * self._beta,) * 2, 1.0]), np.inf
        for _ in range(_MOST_ROUNDS):
            errors = {C: self._controller_error(values, missing) for C, missing in self._missing.items()}
            states = {C: self._state(C) for C in self._plant.outputs}
            rows = np.array(
                [self._tested(self._signals), self._with_age(errors[Output.GAIN], states, errors)]
            )
            solution = solve_inequalities(rows[:, :2], rows[:, 2])
            values = np.append(solution.bound, 1.0)
            if not np.isfinite(values).all():
                return bounds, min(loop_gain, float(solution.loop_gain))
            new_bounds = _Bounds(
                {C: float(row @ values) for C, row in states.items()},
                {C: float(row @ values) for C, row in errors.items()},
                *solution.bound.tolist(),
            )
            if bounds and new_bounds.states[Output.STATE] > _SETTLED * bounds.states[Output.STATE]:
                break
            bounds, loop_gain = new_bounds, float(solution.loop_gain)
        return bounds, loop_gain

    def refine(self, bounds: _Bounds) -> _Bounds:
        """Make bounds smaller; each one that is used holds already."""
        known, loop = (
            self._known_parts(bounds),
            (self._error, self._plant, self._conditions, self._probability),
        )
        functions = quadratic_functions(LossyFlow(*loop), known)
        if not functions and self._conditions.hold_s > 0:
            functions = quadratic_functions(LossyFlow(*loop, counts_age=False), known)
        for _ in range(_MOST_ROUNDS):
            before, bounds = bounds, self._improved(bounds, functions)
            if bounds.states[Output.STATE] > _SETTLED * before.states[Output.STATE]:
                break
        return bounds

    def _known_parts(self, bounds: _Bounds) -> KnownRms:
        """Bound the parts of v; errors[C] bounds both ‖C e_c‖ and ‖C(e_c − ê_c)‖ with a delay."""
        states, errors, conditions = bounds.states, bounds.errors, self._conditions
        gains = dict(self._ages)
        in_flight, by_rate = 0.0, gains.pop(Output.GAIN_RATE)
        if conditions.delay_s > 0:
            missing = self._missing_events(Output.GAIN, self._driving(bounds))
            in_flight = float(missing.recent @ bounds.values)
        other = in_flight + sum(gain * (states[C] + errors[C]) for C, gain in gains.items())
        if conditions.delay_s > 0:
            other += by_rate * errors[Output.GAIN_RATE]
        aged = by_rate * (states[Output.GAIN_RATE] + errors[Output.GAIN_RATE])
        at_start = float(self._start_error) + errors[Output.GAIN] + in_flight if conditions.start_s else 0.0
        return KnownRms(bounds.sensor_error, other, aged, at_start)

    def _driving(self, bounds: _Bounds) -> _SignalRows:
        """Return rows that bound R_E x, and p at all times: before and after the first input, at t_a.

        E‖p‖² ≤ π² + sup‖p‖² P(t < t_a), as t_a may depend on the losses.
        """
        input_error = float(np.hypot(bounds.input_error, self._start_error))
        return _SignalRows(bounds.states[Output.MISMATCH] * _ONE, input_error * _ONE)

    def _improved(self, bounds: _Bounds, functions: Sequence[QuadraticFunction]) -> _Bounds:
        """Bound every signal by what is known of the others."""
        known, delay_s = self._known_parts(bounds), self._conditions.delay_s
        signals, values = self._driving(bounds), bounds.values
        propagated = exponential(self._error.scaled_H * delay_s)
        errors: dict[str, float] = {}
        for output, C in self._error.outputs.items():
            missing = self._missing_events(output, signals)
            by_missing = float(self._controller_error(values, missing) @ values)
            recent = float(missing.recent @ values)
            by_functions = [V.bound_error(C @ propagated, known) + recent for V in functions]
            errors[output] = min([bounds.errors[output], by_missing, *by_functions])
        states = {
            output: min(
                bounds.states[output],
                float(self._state(output) @ values),
                *(V.bound_state(C, known) for V in functions),
            )
            for output, C in self._plant.outputs.items()
        }
        input_error = self._with_age(errors[Output.GAIN], states, errors)
        tested = float(self._tested(signals) @ values)
        return _Bounds(states, errors, min(bounds.sensor_error, tested), min(bounds.input_error, input_error))

    def _with_age(self, total: _Term, states: Mapping[str, _Term], errors: Mapping[str, _Term]) -> _Term:
        """Add to a bound what the input's age adds to p."""
        for C, gain in self._ages.items():
            total = total + gain * (states[C] + errors[C])
        return total

    def _tested(self, signals: _SignalRows) -> Vector:
        """Return the row that bounds a: β, grown until the next test, and what enters before it."""
        sampling_s = self._conditions.sampling_s
        a = self._beta * self._error.stretch(sampling_s) * _ONE
        if sampling_s > 0:
            growth = self._plant.growth(sampling_s, _CELLS)
            areas = growth.mismatch.integral_on_grid(), growth.input_error.integral_on_grid()
            a = a + _input_row(areas, signals)
        return np.asarray(a)

    def _state(self, output: str) -> Vector:
        free, gain = self._plant.states[output]
        return np.asarray(gain * _PI + (free + self._start[output]) * _ONE)

    def _missing_events(self, output: Output, signals: _SignalRows) -> "_Missing":
        """Return what bounds the missing events' part of C e_c, and the present error."""
        error, C, conditions = self._error, self._error.outputs[output], self._conditions
        delay_s, kernels = conditions.delay_s, [drive.through(C) for drive in self._drive]
        ages_s = delay_s + conditions.spacing_s * np.arange(float(_MOST_LOST))
        return _Missing(
            (error.kernels[output].sup(delay_s) if delay_s > 0 else error.now(output)) * _A,
            _input_row((recent.through(C).integral_on_grid() for recent in self._recent), signals),
            _input_row((kernel.integral() for kernel in kernels), signals),
            conditions.sampling_s * _input_row((kernel.sup(delay_s) for kernel in kernels), signals),
            self._beta * error.kernels[output].sups(ages_s),
        )

    def _controller_error(self, values: Vector, missing: "_Missing") -> Vector:
        """The bound of |C e_c|, as tight as can be where the signals have these values."""
        share = np.sqrt(self._probability)
        lost = [share * (missing.whole - missing.recent)]
        whole, overshoot = missing.whole @ values, missing.overshoot @ values
        if share < 1 and whole > 0:
            row = missing.burst(self._probability, float(whole))
            if overshoot > 0:
                ratio = np.sqrt(whole / overshoot)
                row = row + share / (1 - share) / 2 * (ratio * missing.overshoot + missing.whole / ratio)
            lost.append(row)
        best = min(lost, key=lambda row: float(row @ values))
        return np.asarray(missing.present + missing.recent + best)


def _input_row(gains: Iterable[Stack], signals: _SignalRows) -> Vector:
    """Return the row of E x and B p with these gains."""
    return sum((gain * row for gain, row in zip(gains, signals, strict=False)), np.zeros(3))


class _Missing(NamedTuple):
    """Bounds of the part of C e_c that missing events have; all but the last are rows."""

    present: Vector
    """Of e_s, now and when the oldest update in flight was sent."""
    recent: Vector
    """The part added to e_s while updates in flight were sent."""
    whole: Vector
    """The part ever added to e_s."""
    overshoot: Vector
    """The part added to e_s between two tests, at most."""
    ceilings: Vector
    """The largest part of the i-th last event since the last delivery, without the overshoot."""

    def burst(self, probability: float, whole: float) -> Vector:
        """Bound √(Σ_i (S_i² − S_{i−1}²) min(1, p^i D/c_i)) by its tangent at a value of D."""
        c, powers = self.ceilings, probability ** np.arange(1.0, len(self.ceilings) + 1)
        sums = np.cumsum(np.append(0.0, c))
        weights = sums[1:] + sums[:-1]
        few = powers * whole < c
        # Beyond the last one c_i is not larger, and (S_i² − S_{i−1}²)/c_i at most 2 S_i.
        beyond = 2 * probability / (1 - probability) * (sums[-1] + c[-1] / (1 - probability))
        slope = float((weights * powers)[few].sum() + powers[-1] * beyond)
        value = float(np.sqrt((weights * c)[~few].sum() + slope * whole))
        tangent = slope / (2 * value) if slope else 0.0
        return np.asarray(tangent * self.whole + (value - tangent * whole) * _ONE)
