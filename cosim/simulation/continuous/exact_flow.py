"""Exact flow of ``dz/dt = G z`` on a grid of cells, and between its points.

For t = j d + s with 0 ≤ s < d, e^{Gt} = T(s) S^j with S = e^{Gd} and T(s) = Σ_{k≤p} (Gs)^k/k!. The
cell's width d makes the truncated terms smaller than rounding: with
η = max(‖G⁴‖^{1/4}, ‖G⁵‖^{1/5}), ‖G^k‖ ≤ η^k for all k ≥ 12 (Al-Mohy & Higham, 2009), and η d ≤ 1
bounds the terms after degree 18 by Σ_{k>18} 1/k! < 1e-17. Sums and products of blocks keep the
relative accuracy of a small block beside a large one (a small mismatch E). The
scaling-and-squaring of a general-purpose exponential loses it.
"""

import numpy as np

from noack.core.linear_systems import Matrix, Vector

DEGREE = 18
"""p of the Taylor polynomial inside a cell."""
CELLS = 16
"""Cells of one window; the powers S^0 … S^CELLS are kept."""


def growth_rate(generator: Matrix) -> float:
    """η with ‖G^k‖₂ ≤ η^k for all k ≥ 12, per second."""
    fourth = np.linalg.matrix_power(generator, 4)
    # The Frobenius norm bounds the 2-norm from above.
    return float(max(np.linalg.norm(fourth) ** 0.25, np.linalg.norm(fourth @ generator) ** 0.2))


def taylor_terms(generator: Matrix, width_s: float) -> Matrix:
    """(G d)^k/k! for k = 0 … p, shape (p + 1, N, N)."""
    step = generator * width_s
    terms = np.empty((DEGREE + 1, *generator.shape))
    terms[0] = np.eye(len(generator))
    for k in range(1, DEGREE + 1):
        np.matmul(terms[k - 1], step / k, out=terms[k])
    return terms


class ExactFlow:
    """Propagates states of ``dz/dt = G z``; the width d is at most 1/:func:`growth_rate`."""

    def __init__(self, generator: Matrix, width_s: float) -> None:
        self.width_s = width_s
        self.window_s = width_s * CELLS
        size = len(generator)
        self._terms = taylor_terms(generator, width_s)
        self._flat_terms = self._terms.reshape(DEGREE + 1, -1)
        self.powers = np.empty((CELLS + 1, size, size))
        """S^j for j = 0 … CELLS."""
        self.powers[0] = np.eye(size)
        self.powers[1] = self._terms[::-1].sum(axis=0)
        known = 1
        while known < CELLS:
            np.matmul(
                self.powers[1 : known + 1], self.powers[known], out=self.powers[known + 1 :][:known]
            )
            known *= 2
        self._orders = np.arange(DEGREE + 1)

    def within_cell(self, z: Vector, u: float) -> Vector:
        """e^{Gud} ``z`` for 0 ≤ u ≤ 1, shape (N,)."""
        partial = (u**self._orders @ self._flat_terms).reshape(len(z), -1)
        advanced: Vector = partial @ z
        return advanced

    def advance(self, z: Vector, dt_s: float) -> Vector:
        """e^{G dt} ``z``, shape (N,), for any dt ≥ 0."""
        windows, rest_s = divmod(dt_s, self.window_s)
        for _ in range(int(windows)):
            z = self.powers[CELLS] @ z
        cell = int(rest_s / self.width_s)
        start: Vector = self.powers[cell] @ z
        return self.within_cell(start, rest_s / self.width_s - cell)

    def sample(self, z: Vector, dt_s: Vector) -> Matrix:
        """e^{G dt} ``z`` at many dt ≥ 0 at once, shape (len(dt_s), N)."""
        if not len(dt_s):
            return np.empty((0, len(z)))
        cells = np.floor(dt_s / self.width_s).astype(np.int64)
        u = (dt_s / self.width_s - cells)[:, None]
        windows, cells = np.divmod(cells, CELLS)
        starts = np.empty((int(windows.max()) + 1, len(z)))
        starts[0] = z
        for i in range(1, len(starts)):
            starts[i] = self.powers[CELLS] @ starts[i - 1]
        # Horner's scheme over the Taylor terms, all samples at once.
        grid = (self.powers[:CELLS] @ starts.T).transpose(2, 0, 1)  # (window, cell, N)
        first = grid[windows, cells]
        states = first @ self._terms[DEGREE].T
        for term in self._terms[DEGREE - 1 :: -1]:
            states = first @ term.T + u * states
        sampled: Matrix = states
        return sampled
