"""Second moments over an interval of a linear system with noise, and a quadratic cost of it.

Over an interval, x becomes M x + w with the covariance W of w, and the cost ∫ xᵀFx dt of a form F
has the mean xᵀCx + c for a given x. Intervals in sequence make an interval again, so a loop is
composed of flows (:func:`flow`) and of changes at an instant (:func:`jump`). For a flow of a length
t, ẋ = G x with white noise of intensity R,

    M = e^{Gt}, W = ∫₀ᵗ e^{Gs} R e^{Gᵀs} ds, C = ∫₀ᵗ e^{Gᵀs} F e^{Gs} ds,
    c = ∫₀ᵗ (t − s) trace(R e^{Gᵀs} F e^{Gs}) ds.

Where ‖G‖t ≤ 1, Gauss's formula with 12 nodes has an error below that of rounding; a longer interval
is composed of its halves. Whatever the units of the states, e^{Gt} is computed in similar ones.
"""

import math
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector, balancing_exponents, exponential
from noack.theory.bounds.contraction import Stack

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


class MomentStep(NamedTuple):
    """An interval of a system of S states, and K quadratic costs."""

    matrix: Matrix
    """M, (S, S)."""
    noise: Matrix
    """W, (S, S)."""
    costs: Stack
    """C of each cost, (K, S, S)."""
    constants: Vector
    """c of each cost, (K,)."""

    def then(self, later: "MomentStep") -> "MomentStep":
        """Return this interval and the one after it."""
        M = self.matrix
        return MomentStep(
            later.matrix @ M,
            later.matrix @ self.noise @ later.matrix.T + later.noise,
            self.costs + M.T @ later.costs @ M,
            self.constants + later.constants + np.einsum("kij,ij->k", later.costs, self.noise),
        )

    def repeated(self, times: int) -> "MomentStep":
        """Return this interval ``times`` times in sequence."""
        if times == 0:
            return jump(np.eye(len(self.matrix)), len(self.costs))
        half = self.repeated(times // 2)
        whole = half.then(half)
        return whole.then(self) if times % 2 else whole

    def of_first(self, states: int) -> "MomentStep":
        """Leave out all but the first states, of which nothing after the interval depends."""
        kept = slice(states)
        M, W, C = self.matrix[kept, kept], self.noise[kept, kept], self.costs[:, kept, kept]
        return MomentStep(M, W, C, self.constants)


def flow(generator: Matrix, intensity: Matrix, forms: Stack, duration_s: float) -> MomentStep:
    """Return the flow of ẋ = G x + white noise.

    Args:
        generator: G, (S, S).
        intensity: R, (S, S).
        forms: F of each cost, (K, S, S).
        duration_s: t.
    """
    units = np.ldexp(1.0, balancing_exponents(np.abs(generator)))
    per_unit, squares = units[:, None] / units, np.outer(units, units)
    generator, intensity, forms = generator * per_unit, intensity * squares, forms / squares
    size = float(np.linalg.norm(generator)) * duration_s
    halvings = max(math.ceil(math.log2(size)), 0) if size > 1 else 0
    t_s = duration_s / 2**halvings
    times_s, weights = (_NODES + 1) / 2 * t_s, _WEIGHTS / 2 * t_s
    E = np.array([exponential(generator * time_s) for time_s in times_s])
    costs = np.einsum("t,tji,kjl,tlm->tkim", weights, E, forms, E, optimize=True)
    short = MomentStep(
        exponential(generator * t_s) / per_unit,
        np.einsum("t,tij,jl,tml->im", weights, E, intensity, E, optimize=True) / squares,
        costs.sum(axis=0) * squares,
        np.einsum("t,tkij,ij->k", t_s - times_s, costs, intensity),
    )
    return short.repeated(2**halvings)


def jump(matrix: Matrix, costs: int, noise: Matrix | None = None) -> MomentStep:
    """Return a change at an instant, without a cost: x becomes M x + w."""
    size = len(matrix)
    W = np.zeros((size, size)) if noise is None else noise
    return MomentStep(matrix, W, np.zeros((costs, size, size)), np.zeros(costs))
