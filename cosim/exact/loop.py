"""The paper's loop between events, and the exact time of the next one.

In the coordinates z = (x, e_s, e_c), e_s = x_s − x, e_c = x_c − x, the loop between events is
linear and autonomous, and its errors keep their relative accuracy while everything decays:

    ẋ   = (A+BK) x + BK e_c
    ė_s = H e_s − E x − BK e_c          E = A + BK − H  (eq:miet_errdyn)
    ė_c = (H−BK) e_c − E x

with H = Â+B̂K in model mode and H = 0 under zero-order hold. An event is the first t > t_i at which
‖W e_s(t)‖ exceeds max(βe^{−αt}, ε) (eq:thre). There e_s ← 0, and e_c ← 0 if the update arrives.

Why no crossing is skipped. While the threshold is βe^{−αt}, the scaled error
y(t) = W e_s(t) / (βe^{−αt}) is the output of a linear system, too: it is [0 W 0] e^{(G+αI)(t−t₀)}
z(t₀) over the threshold at t₀. The event is where the curve y leaves the unit ball. With the floor
ε in place of βe^{−αt} the same holds for α = 0. Time is cut into cells of a width on which a
polynomial of degree 18 equals y to rounding (:mod:`cosim.exact.flow`). The control points of all
cells of a window are one matrix-vector product. A cell whose control points are in the ball does
not leave it (convex hull); in every other one the roots of 1 − |y|² are isolated
(:mod:`cosim.exact.bernstein`).
Nothing is sampled. What remains is rounding: an excursion above the threshold by less than about
1e-15 ‖z‖/threshold of it may be taken for a tangency, which is no event.
"""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np

from cosim.exact.bernstein import curve_basis
from cosim.exact.flow import CELLS, DEGREE, Flow, growth_rate, taylor_terms
from noack.errors import CallerError
from noack.linear import Matrix, Vector
from noack.resolve import Loop, loop_of
from noack.scenario import Scenario
from noack.trigger.decaying import DecayingTrigger, trigger_of

_LARGEST = 1e100
"""Beyond, a state is said to have diverged: squares and ratios must stay finite."""
_SMALLEST_THRESHOLD = 1e-200
_SLACK = 1e-13


class DivergedError(ArithmeticError):
    """The state has grown beyond 1e100, or by that factor beyond the threshold, at ``t_s``."""

    def __init__(self, t_s: float) -> None:
        super().__init__(f"the loop diverges: the state passes 1e100 at {t_s:g} s")
        self.t_s = t_s


class LoopState(NamedTuple):
    """The loop at a time: plant state and both models' errors, each of shape (n,)."""

    t_s: float
    x: Vector
    e_s: Vector
    e_c: Vector


class Samples(NamedTuple):
    """The loop at k times; states of shape (k, n)."""

    t_s: Vector
    x: Matrix
    e_s: Matrix
    e_c: Matrix

    @property
    def x_s(self) -> Matrix:
        """The sensor's model."""
        return self.x + self.e_s

    @property
    def x_c(self) -> Matrix:
        """The controller's model."""
        return self.x + self.e_c


class ContinuousLoop:
    """The loop of the paper with its trigger; made once for a system, used for many runs.

    Args:
        loop: the matrices.
        trigger: the event-triggering policy; its weight is W.
    """

    def __init__(self, loop: Loop, trigger: DecayingTrigger) -> None:
        self.loop = loop
        self.trigger = trigger
        n, H, BK = loop.n, loop.H, loop.B @ loop.K
        mismatch = loop.A + BK - H
        self.generator: Matrix = np.zeros((3 * n, 3 * n))
        """G of dz/dt = G z, per second, shape (3n, 3n)."""
        self.generator[:n, :n] = loop.A + BK
        self.generator[:n, 2 * n :] = BK
        self.generator[n : 2 * n, :n] = -mismatch
        self.generator[n : 2 * n, n : 2 * n] = H
        self.generator[n : 2 * n, 2 * n :] = -BK
        self.generator[2 * n :, :n] = -mismatch
        self.generator[2 * n :, 2 * n :] = H - BK
        alpha = trigger.alpha_per_s
        scaled = self.generator + alpha * np.eye(3 * n)
        self.flow = Flow(
            self.generator, 1.0 / max(growth_rate(self.generator), growth_rate(scaled))
        )
        self._floor_from_s = (
            math.log(trigger.beta / trigger.floor) / alpha if trigger.floor > 0 else math.inf
        )
        self._vanishes_s = max(math.log(trigger.beta / _SMALLEST_THRESHOLD) / alpha, 0.0)

    @cached_property
    def _decaying(self) -> "_Watch":
        return _Watch(self.flow, self.generator, self._output, self.trigger.alpha_per_s)

    @cached_property
    def _floored(self) -> "_Watch":
        return _Watch(self.flow, self.generator, self._output, 0.0)

    @property
    def _output(self) -> Matrix:
        n, W = self.loop.n, self.trigger.weight
        output = np.zeros((n, 3 * n))
        output[:, n : 2 * n] = np.eye(n) if W is None else W
        return output

    def threshold(self, t_s: float) -> float:
        """max(βe^{−αt}, ε)."""
        decaying = self.trigger.beta * math.exp(-self.trigger.alpha_per_s * t_s)
        return max(decaying, self.trigger.floor)

    def norms(self, errors: Matrix) -> Vector:
        """‖W e‖ of k errors, shape (k, n) → (k,)."""
        W = self.trigger.weight
        norms: Vector = np.linalg.norm(errors if W is None else errors @ W.T, axis=-1)
        return norms

    def next_event(self, state: LoopState, until_s: float) -> LoopState | None:
        """The state just before the reset at the first crossing in [``state.t_s``, ``until_s``].

        Returns:
            None if ‖W e_s‖ does not exceed the threshold until then. A state that is beyond the
            threshold already, or on it and growing, is an event itself.

        Raises:
            DivergedError: the state outgrows what can be computed with before.
            CallerError: the threshold decays below 1e-200 before, where nothing is left to resolve.
        """
        t_s = state.t_s
        z = np.concatenate(state[1:])
        if t_s < self._floor_from_s:
            end_s = min(until_s, self._floor_from_s, self._vanishes_s)
            found = self._decaying.first_exit(z, t_s, self.threshold(t_s), end_s - t_s)
            if found is not None:
                return self._state(t_s + found[0], found[1])
            if until_s <= min(self._floor_from_s, self._vanishes_s):
                return None
            if self._vanishes_s < self._floor_from_s:
                raise CallerError(
                    f"trigger: from {self._vanishes_s:g} s on the threshold is below "
                    f"{_SMALLEST_THRESHOLD:g}, where no error can be told from rounding; "
                    "give trigger.floor or a shorter horizon"
                )
            z = self.flow.advance(z, self._floor_from_s - t_s)
            t_s = self._floor_from_s
        found = self._floored.first_exit(z, t_s, self.trigger.floor, until_s - t_s)
        return None if found is None else self._state(t_s + found[0], found[1])

    def propagate(self, state: LoopState, t_s: float) -> LoopState:
        """The state at ``t_s`` ≥ ``state.t_s``, no event happening in between."""
        return self._state(t_s, self.flow.advance(np.concatenate(state[1:]), t_s - state.t_s))

    def sample(self, state: LoopState, t_s: Vector) -> Samples:
        """The states at many times ≥ ``state.t_s``, no event happening in between."""
        t_s = np.asarray(t_s, dtype=np.float64)
        states = self.flow.sample(np.concatenate(state[1:]), t_s - state.t_s)
        return Samples(t_s, *np.split(states, 3, axis=1))

    def _state(self, t_s: float, z: Vector) -> LoopState:
        n = self.loop.n
        return LoopState(t_s, z[:n], z[n : 2 * n], z[2 * n :])


def reset(state: LoopState, delivered: bool) -> LoopState:
    """The state after an event: e_s = 0, and e_c = 0 if the update arrives."""
    nothing = np.zeros_like(state.e_s)
    return LoopState(state.t_s, state.x, nothing, nothing if delivered else state.e_c)


def continuous_loop_of(resolved: Scenario) -> ContinuousLoop:
    """Return the exact loop of a resolved scenario."""
    return ContinuousLoop(loop_of(resolved), trigger_of(resolved))


class _Watch:
    """Finds where the scaled error y leaves the unit ball.

    Args:
        flow: of the state z.
        generator: G, shape (3n, 3n).
        output: [0 W 0], shape (n, 3n).
        alpha_per_s: rate at which the threshold decays; 0 for a constant one.
    """

    def __init__(self, flow: Flow, generator: Matrix, output: Matrix, alpha_per_s: float) -> None:
        n, size = output.shape
        terms = taylor_terms(generator + alpha_per_s * np.eye(size), flow.width_s)
        self._flow = flow
        self._alpha_per_s = alpha_per_s
        self._basis = curve_basis(DEGREE)
        self._growth = np.exp(alpha_per_s * flow.width_s * np.arange(CELLS))
        self._taylor: Matrix = output @ terms
        """Taylor coefficients of y from z at the start of a cell, shape (p + 1, n, 3n)."""
        control = np.tensordot(self._basis.from_taylor, self._taylor, 1).reshape(-1, size)
        starts = flow.powers[:CELLS] * self._growth[:, None, None]
        self._control = (control @ starts).reshape(-1, size)
        """Control points of y in all cells of a window, one below the other."""
        self._shape = (-1, DEGREE + 1, n)
        self._slack = _SLACK * max(float(np.abs(self._control).sum(axis=1).max()), 1.0)

    def first_exit(
        self, z: Vector, t_s: float, threshold: float, span_s: float
    ) -> tuple[float, Vector] | None:
        """Time and state of the first exit in [0, ``span_s``] after ``t_s``, or None.

        Args:
            z: state at ``t_s``, shape (3n,).
            t_s: time.
            threshold: at ``t_s``.
            span_s: how far to look.

        Raises:
            DivergedError: the state outgrows what can be computed with.
        """
        width_s, window_s = self._flow.width_s, self._flow.window_s
        rows, window = len(self._control) // CELLS, 0
        while True:
            begin_s = window * window_s
            scale = math.exp(self._alpha_per_s * begin_s) / threshold
            largest = float(np.abs(z).max())
            if not largest * max(scale, 1.0) < _LARGEST:
                raise DivergedError(t_s + begin_s)
            cells = max(min(CELLS, math.ceil((span_s - begin_s) / width_s)), 1)
            control = (self._control[: cells * rows] @ (z * scale)).reshape(self._shape)
            reach = np.einsum("cki,cki->ck", control, control).max(axis=1)
            for cell in np.flatnonzero(reach > 1.0 - self._slack * (1.0 + largest * scale)):
                start = self._flow.powers[cell] @ z
                u = self._basis.first_exit(self._taylor @ (start * (scale * self._growth[cell])))
                if u is not None:
                    after_s = begin_s + (cell + u) * width_s
                    if after_s > span_s:
                        return None
                    return float(after_s), self._flow.within_cell(start, u)
            window += 1
            if window * window_s >= span_s:
                return None
            z = self._flow.powers[CELLS] @ z
