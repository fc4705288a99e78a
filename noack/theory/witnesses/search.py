"""The search for a witness: quadratic forms for all locations, found in floating point.

Nothing here has to be right: :mod:`noack_check` verifies what is found. The coordinates decide whether
the solver succeeds. They come from simulated runs first, and from the first solution then.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix
from noack.theory.witnesses.coordinates import Frames, floats
from noack.theory.witnesses.semidefinite import MatrixInequality, SolverAnswer, minimise
from noack_check.model import Inequality, Model


class Found(NamedTuple):
    """A solution in the model's own coordinates; the bound is D₁² and D₂²."""

    matrices: Mapping[str, Matrix]
    numbers: Mapping[str, float]
    status: str
    size: float
    """What was minimised: (D₁² + D₂²)^½ from the start on, D₂ in the limit."""

    @property
    def levels(self) -> tuple[float, float]:
        """D₁ and D₂."""
        decaying, constant = (max(self.numbers.get(f"level {i}", 0.0), 0.0) ** 0.5 for i in (1, 2))
        return decaying, constant


class Search:
    """The search for bounds of one model's outputs."""

    def __init__(self, model: Model, frames: Frames) -> None:
        self.model, self.frames = model, dict(frames)
        level, floor = float(model.loop.rule.level), float(model.loop.rule.floor)
        self._f_units = (1.0, level / floor if level and floor else 1.0)

    def solve(self, output: str, *, starts: bool, margin: float = 1e-7, tolerance: float = 1e-8) -> Found:
        """Return the smallest bound of an output for this model's ν: from the start on, or in the limit."""
        model = self.model
        size = self._output_size(output)
        problem = [self._scaled(item, size) for item in model.inequalities(output, starts=starts)]
        units = _units(problem)
        problem = [
            item._replace(scalars=tuple((name, units[name] * M) for name, M in item.scalars))
            for item in problem
        ]
        objective = {
            name: weight * units[name]
            for name, weight in (("level 1", 1.0 if starts else 1e-6), ("level 2", 1.0))
            if name in units
        }
        largest = max(objective.values())
        objective = {name: w / largest for name, w in objective.items()}
        free = {name for name in units if name.startswith("c")}
        solution = minimise(objective, problem, free=free, margin=margin, tolerance=tolerance)
        found = self._unscaled(solution, size, units)
        return found._replace(size=float(np.hypot(*found.levels)) if starts else found.levels[1])

    def _output_size(self, output: str) -> float:
        place = self.model.locations[min(1, len(self.model.locations) - 1)]
        rows = floats(self.model.output(output, place)[0][0])[:, list(place.coordinates)]
        return float(np.linalg.norm(rows @ self._frame(min(1, len(self.model.locations) - 1)))) or 1.0

    def _frame(self, location: int) -> Matrix:
        """Return the coordinates of a location: block diagonal of those of its matrices."""
        form = self.model.form(location, 0)
        place = self.model.locations[location]
        N = len(place.coordinates)
        frame = np.eye(N)
        for f in (0, 1):
            row = self.model.size - 2 + f
            if row in place.coordinates:
                at = place.coordinates.index(row)
                frame[at, at] = self._f_units[f]
        for name, S in form.parts:
            where = [int(np.flatnonzero(row)[0]) for row in floats(S)]
            frame[np.ix_(where, where)] = self.frames[name]
        return frame

    def _scaled(self, item: Inequality, size: float) -> MatrixInequality:
        parts = []
        for part in item.parts:
            inverse = np.linalg.inv(self.frames[part.name])
            parts.append((part.name, inverse @ floats(part.left), inverse @ floats(part.right)))
        scalars = tuple((name, floats(M)) for name, M in item.scalars)
        constant = floats(item.constant) / size**2
        result = MatrixInequality(tuple(parts), scalars, constant)
        if item.signals < 0:
            return result
        frame = self._frame(item.location)
        q = len(constant)
        whole = np.eye(q)
        whole[: len(frame), : len(frame)] = frame
        return result.within(whole[:, _occurring(result, whole)])

    def _unscaled(self, solution: SolverAnswer, size: float, units: Mapping[str, float]) -> Found:
        matrices = {}
        for name, V in solution.matrices.items():
            inverse = np.linalg.inv(self.frames[name])
            matrices[name] = size**2 * inverse.T @ V @ inverse
        numbers = {name: size**2 * units[name] * value for name, value in solution.numbers.items()}
        return Found(matrices, numbers, solution.status, 0.0)


def refined(frames: Frames, found: Found) -> Frames:
    """Return the coordinates in which the matrices of a solution are of order 1."""
    scale = max(found.size, 1e-150)
    better = dict(frames)
    for name, V in found.matrices.items():
        T = frames[name]
        values, vectors = np.linalg.eigh(T.T @ V @ T)
        better[name] = scale * T @ vectors / np.sqrt(np.maximum(values, 1e-6 * values[-1]))
    return better


def _occurring(inequality: MatrixInequality, frame: Matrix) -> list[int]:
    """Return the coordinates that occur in an inequality."""
    found = np.zeros(len(frame), bool)
    for _, left, right in inequality.parts:
        found |= (left @ frame).any(0) | (right @ frame).any(0)
    for M in [*(M for _, M in inequality.scalars), inequality.constant]:
        found |= (M @ frame).any(0)
    return [int(i) for i in np.flatnonzero(found)]


def _units(problem: list[MatrixInequality]) -> dict[str, float]:
    """Return for each number the unit in which its largest matrix entry is 1."""
    largest: dict[str, float] = {}
    for item in problem:
        for name, M in item.scalars:
            largest[name] = max(largest.get(name, 0.0), float(np.abs(M).max()))
    return {name: 1.0 / value if value else 1.0 for name, value in largest.items()}
