"""Linear matrix inequalities in named matrices and numbers, solved by Clarabel.

    minimise Σ weight · number,  subject to  Σ (LᵀVR + RᵀVL) + Σ number · M + C ⪰ 0.

Clarabel is called directly: a modelling layer needs longer to build these problems than to solve them.
"""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import clarabel
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Vector

Indices = NDArray[np.int64]

_SMALLEST = 1e-11
"""Smaller entries are left out: the solver loses accuracy by them."""


class Accuracy(NamedTuple):
    """When the solver may stop, and whether it improves each of its steps, which doubles its time."""

    gap: float
    """Relative error of the objective."""
    feasibility: float
    """Error of the inequalities."""
    improves_steps: bool


class MatrixInequality(NamedTuple):
    """Σ (LᵀVR + RᵀVL) + Σ number · M + C ⪰ 0, of named V and numbers."""

    parts: tuple[tuple[str, Matrix, Matrix], ...]
    scalars: tuple[tuple[str, Matrix], ...]
    constant: Matrix

    def within(self, frame: Matrix) -> "MatrixInequality":
        """Return frameᵀ(·)frame."""
        return MatrixInequality(
            tuple((name, left @ frame, right @ frame) for name, left, right in self.parts),
            tuple((name, frame.T @ M @ frame) for name, M in self.scalars),
            frame.T @ self.constant @ frame,
        )

    def scaled(self, factor: float) -> "MatrixInequality":
        """Return factor · (·)."""
        return MatrixInequality(
            tuple((name, factor * left, right) for name, left, right in self.parts),
            tuple((name, factor * M) for name, M in self.scalars),
            factor * self.constant,
        )


class SolverAnswer(NamedTuple):
    """What the solver found; ``status`` is its own word."""

    status: str
    matrices: Mapping[str, Matrix]
    numbers: Mapping[str, float]

    @property
    def is_solved(self) -> bool:
        """Whether the solver claims a solution; only a check can tell."""
        return self.status in {"Solved", "AlmostSolved"}

    @property
    def is_inaccurate(self) -> bool:
        """Whether the solver ended by rounding errors."""
        return self.status in {"NumericalError", "InsufficientProgress"}


def minimise(
    objective: Mapping[str, float],
    inequalities: Iterable[MatrixInequality],
    *,
    free: Iterable[str] = (),
    margin: float,
    accuracy: Accuracy,
) -> SolverAnswer:
    """Return numbers and matrices that obey all inequalities with a margin.

    Args:
        objective: weights of numbers.
        inequalities: all of them.
        free: numbers that may be negative.
        margin: each inequality is solved as (·) ⪰ margin · 1.
        accuracy: of the solution; if rounding errors end the solver, its steps are improved in any case.
    """
    problem = _Problem()
    for inequality in inequalities:
        problem.add(inequality, margin)
    answer = problem.solve(objective, set(free), accuracy)
    if answer.is_inaccurate and not accuracy.improves_steps:
        return problem.solve(objective, set(free), accuracy._replace(improves_steps=True))
    return answer


class _Problem:
    """Assembles Clarabel's data: A x + s = b, s in the cones."""

    def __init__(self) -> None:
        self._first: dict[str, int] = {}
        self._sizes: dict[str, int] = {}
        self._count = 0
        self._rows: list[Indices] = []
        self._columns: list[Indices] = []
        self._values: list[Vector] = []
        self._right: list[Vector] = []
        self._cones: list[object] = []
        self._height = 0

    def _variable(self, name: str, size: int) -> int:
        """Return the first column of a variable; size 0 is a number, n a symmetric (n, n)."""
        if name not in self._first:
            self._first[name], self._sizes[name] = self._count, size
            self._count += size * (size + 1) // 2 if size else 1
        return self._first[name]

    def add(self, inequality: MatrixInequality, margin: float) -> None:
        q = len(inequality.constant)
        j, i = np.triu_indices(q)[::-1]
        order = np.lexsort((i, j))  # column by column of the upper triangle
        i, j = i[order], j[order]
        scale = np.where(i == j, 1.0, np.sqrt(2.0))
        for name, left, right in inequality.parts:
            first = self._variable(name, len(left))
            a, b = np.triu_indices(len(left))
            entries = left[a][:, i] * right[b][:, j] + right[b][:, i] * left[a][:, j]
            entries += np.where(
                (a == b)[:, None], 0.0, left[b][:, i] * right[a][:, j] + right[a][:, i] * left[b][:, j]
            )
            self._append(entries * scale, first + np.arange(len(a)))
        for name, M in inequality.scalars:
            self._append((M[i, j] * scale)[None], np.array([self._variable(name, 0)]))
        self._right.append((inequality.constant[i, j] - margin * (i == j)) * scale)
        self._cones.append(clarabel.PSDTriangleConeT(q))
        self._height += len(i)

    def _append(self, entries: Matrix, columns: Indices) -> None:
        which, where = np.nonzero(np.abs(entries) > _SMALLEST)
        self._rows.append(self._height + where)
        self._columns.append(columns[which])
        self._values.append(-entries[which, where])

    def solve(self, objective: Mapping[str, float], free: set[str], accuracy: Accuracy) -> SolverAnswer:
        signed = [self._first[name] for name, size in self._sizes.items() if not size and name not in free]
        rows = np.concatenate([*self._rows, self._height + np.arange(len(signed))])
        columns = np.concatenate([*self._columns, np.array(signed, dtype=int)])
        values = np.concatenate([*self._values, -np.ones(len(signed))])
        height = self._height + len(signed)
        A = sp.csc_matrix((values, (rows, columns)), (height, self._count))
        A.sum_duplicates()
        b = np.concatenate([*self._right, np.zeros(len(signed))])
        cost = np.zeros(self._count)
        for name, weight in objective.items():
            cost[self._first[name]] = weight
        settings = clarabel.DefaultSettings()
        settings.verbose, settings.max_threads = False, 1
        settings.direct_solve_method = "faer"  # large blocks need a third of the time that QDLDL needs
        settings.tol_gap_rel = settings.tol_gap_abs = accuracy.gap
        settings.tol_feas = accuracy.feasibility
        settings.iterative_refinement_enable = accuracy.improves_steps
        quadratic = sp.csc_matrix((self._count, self._count))
        cones = [*self._cones, clarabel.NonnegativeConeT(len(signed))]
        answer = clarabel.DefaultSolver(quadratic, cost, A, b, cones, settings).solve()
        return self._solution(str(answer.status), np.array(answer.x))

    def _solution(self, status: str, x: Vector) -> SolverAnswer:
        matrices, numbers = {}, {}
        for name, first in self._first.items():
            n = self._sizes[name]
            if not n:
                numbers[name] = float(x[first])
                continue
            a, b = np.triu_indices(n)
            V = np.zeros((n, n))
            V[a, b] = V[b, a] = x[first : first + len(a)]
            matrices[name] = V
        return SolverAnswer(status, matrices, numbers)
