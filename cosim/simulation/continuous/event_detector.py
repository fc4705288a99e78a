"""Finds the first time at which a trigger comparison holds, while the loop follows ``dz/dt = G z``.

No sampling: time is divided into cells on which a polynomial of degree 18 equals z up to rounding
(:mod:`cosim.simulation.continuous.exact_flow`). The roots of the comparison's polynomial are
isolated in the Bernstein basis (:mod:`cosim.simulation.continuous.bernstein`).
"""

import math
from typing import NamedTuple, Protocol

import numpy as np

from cosim.simulation.continuous.bernstein import curve_basis
from cosim.simulation.continuous.exact_flow import CELLS, DEGREE, ExactFlow, taylor_terms
from noack.core.linear_systems import Matrix, Vector
from noack.trigger.trigger_condition import QuadraticForm

LARGEST = 1e100
"""A state above this norm counts as diverged: squares and ratios must stay finite."""
_SLACK = 1e-13


class DivergedError(ArithmeticError):
    """At ``t_s`` the state exceeded 1e100, or 1e100 times the threshold."""

    def __init__(self, t_s: float) -> None:
        super().__init__(f"the loop diverges: the state passes 1e100 at {t_s:g} s")
        self.t_s = t_s


class DetectedEvent(NamedTuple):
    """The result of a search for an event."""

    after_s: float
    z: Vector
    auxiliary: float
    """η, or the integral."""
    exceeds: bool
    """Whether the comparison holds just after this time; otherwise this is the end of the span."""


class EventDetector(Protocol):
    """Finds when the comparison of a trigger condition first holds."""

    def first_exit(
        self, z: Vector, t_s: float, threshold: float, span_s: float, auxiliary: float
    ) -> DetectedEvent:
        """Follow the loop until the comparison holds or the span ends.

        Raises:
            DivergedError: the state becomes too large to compute with.
        """
        ...


class NormEventDetector:
    """Finds the first time at which ‖C z‖ exceeds a decaying threshold; ``output`` is C, (r, N)."""

    def __init__(
        self, flow: ExactFlow, generator: Matrix, output: Matrix, rate_per_s: float
    ) -> None:
        n, size = output.shape
        terms = taylor_terms(generator + rate_per_s * np.eye(size), flow.width_s)
        self._flow = flow
        self._rate_per_s = rate_per_s
        self._basis = curve_basis(DEGREE)
        self._growth = np.exp(rate_per_s * flow.width_s * np.arange(CELLS))
        self._taylor: Matrix = output @ terms
        """Taylor coefficients of y from z at the start of a cell, shape (p + 1, r, N)."""
        control = np.tensordot(self._basis.from_taylor, self._taylor, 1).reshape(-1, size)
        starts = flow.powers[:CELLS] * self._growth[:, None, None]
        self._control = (control @ starts).reshape(-1, size)
        """Control points of y in all cells of a window, stacked as rows."""
        self._shape = (-1, DEGREE + 1, n)
        self._slack = _SLACK * max(float(np.abs(self._control).sum(axis=1).max()), 1.0)

    def first_exit(
        self, z: Vector, t_s: float, threshold: float, span_s: float, auxiliary: float = 0.0
    ) -> DetectedEvent:
        """As :meth:`EventDetector.first_exit`."""
        start = z
        width_s, window_s = self._flow.width_s, self._flow.window_s
        rows, window = len(self._control) // CELLS, 0
        while window == 0 or window * window_s < span_s:
            begin_s = window * window_s
            scale = math.exp(self._rate_per_s * begin_s) / threshold
            largest = float(np.linalg.norm(z))
            if not largest * max(scale, 1.0) < LARGEST:
                raise DivergedError(t_s + begin_s)
            cells = max(min(CELLS, math.ceil((span_s - begin_s) / width_s)), 1)
            control = (self._control[: cells * rows] @ (z * scale)).reshape(self._shape)
            reach = np.einsum("cki,cki->ck", control, control).max(axis=1)
            for cell in np.flatnonzero(reach > 1.0 - self._slack * (1.0 + largest * scale)):
                in_cell = self._flow.powers[cell] @ z
                u = self._basis.first_exit(self._taylor @ (in_cell * (scale * self._growth[cell])))
                after_s = math.inf if u is None else float(begin_s + (cell + u) * width_s)
                if u is not None and after_s <= span_s:
                    found = self._flow.within_cell(in_cell, u)
                    return DetectedEvent(after_s, found, auxiliary, exceeds=True)
            window += 1
            z = self._flow.powers[CELLS] @ z
        return DetectedEvent(span_s, self._flow.advance(start, span_s), auxiliary, exceeds=False)


class QuadraticEventDetector:
    """Finds the first time at which ‖P z‖² − ‖N z‖² − η exceeds c²; c is a decaying threshold or 0.

    On a cell all terms are polynomials: z has degree p, the squares have degree 2p. The dynamic
    variable η, with η̇ = −λη + ‖P_η z‖² − ‖N_η z‖², is its Taylor series up to degree 2p = 36.

    Args:
        flow: the exact flow of the state z, with cells of at most 1/(λ + ρ).
        generator: G, shape (N, N).
        form: P and N, on the first 2n entries of z; without P, only η is computed.
        rate_per_s: ρ of the threshold c e^{−ρt}; 0 if there is an η.
        gain: P_η and N_η, if there is an η.
        decay_per_s: λ.
    """

    def __init__(
        self,
        flow: ExactFlow,
        generator: Matrix,
        form: QuadraticForm,
        rate_per_s: float = 0.0,
        gain: QuadraticForm | None = None,
        decay_per_s: float = 0.0,
    ) -> None:
        if gain is not None and rate_per_s:
            raise ValueError("a threshold that decays cannot be combined with η")
        size = len(generator)
        self._flow, self._rate_per_s = flow, rate_per_s
        self._basis = curve_basis(DEGREE)
        self._growth = np.exp(rate_per_s * flow.width_s * np.arange(CELLS))
        terms = taylor_terms(generator + rate_per_s * np.eye(size), flow.width_s)
        self._cells = terms[None] @ (flow.powers[:CELLS] * self._growth[:, None, None])[:, None]
        """Taylor coefficients of the scaled z in all cells of a window, (cells, p + 1, N, N)."""
        self._form = _Squares(form, self._cells)
        self._compares = len(form.up) > 0
        self._gain = None if gain is None else _Squares(gain, self._cells)
        self._by_start, self._by_gain = _dynamic_variable_series(decay_per_s, flow.width_s)

    def first_exit(
        self, z: Vector, t_s: float, threshold: float, span_s: float, auxiliary: float = 0.0
    ) -> DetectedEvent:
        """As :meth:`EventDetector.first_exit`; the threshold may be 0."""
        width_s, begin_s = self._flow.width_s, 0.0
        while True:
            largest = float(np.linalg.norm(z))
            level = threshold * math.exp(-self._rate_per_s * begin_s)
            if not largest < LARGEST or (level > 0 and not largest / level < LARGEST):
                raise DivergedError(t_s + begin_s)
            scale = 1.0 / max(level if level > 0 else largest, math.sqrt(abs(auxiliary)), 1e-300)
            inside = (level * scale) ** 2 - self._form.bernstein(z * scale)
            eta = self._eta_series(z * scale, auxiliary * scale**2)
            if eta is not None:
                inside += eta @ curve_basis(2 * DEGREE).from_taylor.T
            last = min(int((span_s - begin_s) / width_s), CELLS)
            for cell in np.flatnonzero(inside.min(axis=1) < 0) if self._compares else ():
                u = self._basis.first_negative(inside[cell]) if cell <= last else None
                if u is not None and begin_s + (cell + u) * width_s <= span_s:
                    return self._reached(begin_s, z, int(cell), u, eta, scale, exceeds=True)
            if last < CELLS:
                u = min((span_s - begin_s) / width_s - last, 1.0)
                return self._reached(begin_s, z, last, u, eta, scale, exceeds=False)
            if eta is not None:
                auxiliary = float(eta[-1].sum()) / scale**2
            z = self._flow.powers[CELLS] @ z
            begin_s += self._flow.window_s

    def _eta_series(self, z: Vector, auxiliary: float) -> Matrix | None:
        """Scaled Taylor coefficients of η in all cells of a window, shape (cells, 2p + 1)."""
        if self._gain is None:
            return None
        eta = self._gain.taylor(z) @ self._by_gain.T
        for cell in range(CELLS):
            eta[cell] += auxiliary * self._by_start
            auxiliary = float(eta[cell].sum())
        return eta

    def _reached(
        self,
        begin_s: float,
        z: Vector,
        cell: int,
        u: float,
        eta: Matrix | None,
        scale: float,
        *,
        exceeds: bool,
    ) -> DetectedEvent:
        auxiliary = 0.0
        if eta is not None:
            auxiliary = float(u ** np.arange(eta.shape[1]) @ eta[cell]) / scale**2
        return DetectedEvent(
            begin_s + (cell + u) * self._flow.width_s,
            self._flow.within_cell(self._flow.powers[cell] @ z, u),
            auxiliary,
            exceeds,
        )


class _Squares:
    """A quadratic form on the first entries of z, in all cells of a window at once."""

    def __init__(self, form: QuadraticForm, cells: Matrix) -> None:
        rows = np.vstack([form.up, form.down])
        output = np.zeros((len(rows), cells.shape[-1]))
        output[:, : rows.shape[1]] = rows
        self._signs = np.concatenate([np.ones(len(form.up)), -np.ones(len(form.down))])
        self._taylor: Matrix = output @ cells
        """(cells, p + 1, r, N)."""
        basis = curve_basis(DEGREE)
        self._control: Matrix = np.einsum("ik,ckrn->cirn", basis.from_taylor, self._taylor)
        self._square = basis.square
        self._convolve = _convolution(DEGREE)

    def taylor(self, z: Vector) -> Matrix:
        """Taylor coefficients of the form, shape (cells, 2p + 1)."""
        return self._products(self._taylor @ z) @ self._convolve.T

    def bernstein(self, z: Vector) -> Matrix:
        """Bernstein coefficients of the form, shape (cells, 2p + 1)."""
        return self._products(self._control @ z) @ self._square.T

    def _products(self, y: Matrix) -> Matrix:
        products: Matrix = (y * self._signs) @ y.transpose(0, 2, 1)
        return products.reshape(len(y), -1)


def _convolution(degree: int) -> Matrix:
    """Return the matrix that sums all products a_i b_j with i + j = m, (2p + 1, (p + 1)²)."""
    orders = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).ravel()
    return np.asarray(orders[None] == np.arange(2 * degree + 1)[:, None], dtype=np.float64)


def _dynamic_variable_series(decay_per_s: float, width_s: float) -> tuple[Vector, Matrix]:
    """Return the linear maps that give the Taylor coefficients of η on a cell.

    η_{k+1} = d (w_k − λη_k)/(k + 1), with the coefficients w_k of η's gain.

    Returns:
        The factor of η at the cell's start, (2p + 1,), and that of w, (2p + 1, 2p + 1).
    """
    size = 2 * DEGREE + 1
    by_start, by_gain = np.zeros(size), np.zeros((size, size))
    by_start[0] = 1.0
    for k in range(size - 1):
        by_start[k + 1] = -decay_per_s * width_s * by_start[k] / (k + 1)
        by_gain[k + 1] = -decay_per_s * width_s * by_gain[k] / (k + 1)
        by_gain[k + 1, k] += width_s / (k + 1)
    return by_start, by_gain
