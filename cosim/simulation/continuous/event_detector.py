"""Finds the first time at which a trigger comparison holds, while the loop follows ``dz/dt = G z``.

No sampling: time is divided into cells on which a polynomial of degree 18 equals z up to rounding
(:mod:`cosim.simulation.continuous.exact_flow`). The roots of the comparison's polynomial are
isolated in the Bernstein basis (:mod:`cosim.simulation.continuous.bernstein`).
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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


class QuadraticEventDetector:
    """Finds the first time at which ‖P z‖² − ‖N z‖² − η exceeds c²; c is a decaying threshold or 0.

    On a cell all terms are polynomials: z has degree p, the squares have degree 2p. The dynamic
    variable η, with η̇ = −λη + ‖P_η z‖² − ‖N_η z‖², is its Taylor series up to degree 2p = 36. The
    control points of P z show in which cells there may be an event.

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
        self._flow, self._rate_per_s = flow, rate_per_s
        self._basis = curve_basis(DEGREE)
        growth = np.exp(rate_per_s * flow.width_s * np.arange(CELLS))
        terms = taylor_terms(generator + rate_per_s * np.eye(len(generator)), flow.width_s)
        cells: Matrix = terms[None] @ (flow.powers[:CELLS] * growth[:, None, None])[:, None]
        # Maps the scaled z to its Taylor coefficients in all cells, (cells, p + 1, N, N).
        self._form = _Squares(form, cells)
        self._compares = len(form.up) > 0
        self._gain = None if gain is None else _Squares(gain, cells)
        self._by_start, self._by_gain = _dynamic_variable_series(decay_per_s, flow.width_s)

    def first_exit(
        self, z: Vector, t_s: float, threshold: float, span_s: float, auxiliary: float = 0.0
    ) -> DetectedEvent:
        """Follow the loop until the comparison holds or the span ends.

        Args:
            z: state at ``t_s``, shape (N,).
            t_s: time.
            threshold: at ``t_s``; it may be 0.
            span_s: length of the span.
            auxiliary: η at ``t_s``.

        Raises:
            DivergedError: the state becomes too large to compute with.
        """
        width_s, begin_s = self._flow.width_s, 0.0
        while True:
            largest = float(np.linalg.norm(z))
            level = threshold * math.exp(-self._rate_per_s * begin_s)
            if not largest < LARGEST or (level > 0 and not largest / level < LARGEST):
                raise DivergedError(t_s + begin_s)
            scale = 1.0 / max(level if level > 0 else largest, math.sqrt(abs(auxiliary)), 1e-300)
            eta = self._eta_series(z * scale, auxiliary * scale**2)
            last = min(int((span_s - begin_s) / width_s), CELLS)
            for cell, u in self._crossings(z * scale, level * scale, eta):
                if cell <= last and begin_s + (cell + u) * width_s <= span_s:
                    return self._reached(begin_s, z, cell, u, eta, scale, exceeds=True)
            if last < CELLS:
                u = min((span_s - begin_s) / width_s - last, 1.0)
                return self._reached(begin_s, z, last, u, eta, scale, exceeds=False)
            if eta is not None:
                auxiliary = float(eta[-1].sum()) / scale**2
            z = self._flow.powers[CELLS] @ z
            begin_s += self._flow.window_s

    def _crossings(
        self, z: Vector, level: float, eta: Matrix | None
    ) -> Iterator[tuple[int, float]]:
        """Yield each cell of a window with an event, and the event's place in it."""
        if not self._compares:
            return
        cells = np.arange(CELLS)
        if eta is None:
            cells = np.flatnonzero(self._form.reach(z) > level**2 - _SLACK * (1.0 + float(z @ z)))
        inside = level**2 - self._form.bernstein(z, cells)
        if eta is not None:
            inside += eta @ curve_basis(2 * DEGREE).from_taylor.T
        for i in np.flatnonzero((inside < 0).any(axis=1)):
            u = self._basis.first_negative(inside[i])
            if u is not None:
                yield int(cells[i]), u

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
    """A quadratic form on the first entries of z, in all cells of a window at once.

    Args:
        form: the form.
        cells: map from z at the window's start to the Taylor coefficients of z in the cells.
    """

    def __init__(self, form: QuadraticForm, cells: Matrix) -> None:
        rows = np.vstack([form.up, form.down])
        self._up = len(form.up)
        self._signs = np.concatenate([np.ones(self._up), -np.ones(len(form.down))])
        self._taylor: Matrix = on_state(rows, cells.shape[-1]) @ cells
        """(cells, p + 1, r, N)."""
        basis = curve_basis(DEGREE)
        self._control: Matrix = np.einsum("ik,ckrn->cirn", basis.from_taylor, self._taylor)
        self._square = basis.square
        self._convolve = _convolution(DEGREE)

    def reach(self, z: Vector) -> Vector:
        """An upper bound on ‖P z‖² in each cell, from its control points, shape (cells,)."""
        up = self._control[:, :, : self._up] @ z
        return np.einsum("ckr,ckr->ck", up, up).max(axis=1)

    def taylor(self, z: Vector) -> Matrix:
        """Taylor coefficients of the form, shape (cells, 2p + 1)."""
        return self._products(self._taylor @ z) @ self._convolve.T

    def bernstein(self, z: Vector, cells: NDArray[np.int64]) -> Matrix:
        """Bernstein coefficients of the form in some cells, shape (len(cells), 2p + 1)."""
        return self._products(self._control[cells] @ z) @ self._square.T

    def _products(self, y: Matrix) -> Matrix:
        products: Matrix = (y * self._signs) @ y.transpose(0, 2, 1)
        return products.reshape(len(y), -1)


def on_state(rows: Matrix, size: int) -> Matrix:
    """Return the output matrix, on a state of ``size`` entries, of rows on its first entries."""
    return np.pad(rows, ((0, 0), (0, size - rows.shape[1])))


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
