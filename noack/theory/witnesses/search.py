"""The search for a witness: quadratic forms for all locations, found in floating point.

Nothing here has to be right: the kernel verifies what is found. The coordinates decide whether the solver
succeeds. They come from simulated runs first, and from the first solution then.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix
from noack.proof.semidefinite import Accuracy, MatrixInequality, SolverAnswer, minimise
from noack.theory.witnesses.coordinates import MEMORY, Frames, floats
from noack.theory.witnesses.templates import Template, Templates

_CONSTANT_WEIGHT = 100.0
"""Of D₂² of an output."""
_OF_THRESHOLDS = ("drift", "e_s", "e_c")
"""What is measured in the thresholds c and f; not in forms of each test, of which fewer are proven then."""
FREE = ("c", "eta")
"""Numbers with such names may be negative."""
_SHORT = "short by/"
_LEVEL_WEIGHT = 1e-9
"""Of D₁² and D₂² where shortfalls are minimised."""


class Found(NamedTuple):
    """A solution in the model's own coordinates; the bound is D₁² and D₂²."""

    matrices: Mapping[str, Matrix]
    numbers: Mapping[str, float]
    size: float
    """What was minimised, a root: see :meth:`Search.solve`."""

    @property
    def levels(self) -> tuple[float, float]:
        """D₁ and D₂."""
        decaying, constant = (max(self.numbers.get(f"level {i}", 0.0), 0.0) ** 0.5 for i in (1, 2))
        return decaying, constant


class Shortfall(NamedTuple):
    """The inequality (·) ⪰ 0 that is missed by most: (·) + ``share`` · 1 ⪰ 0 is possible.

    The coordinates are those of the search, in which states of simulated runs and the bounded output have
    about the size 1.
    """

    name: str
    share: float


class Search:
    """The search for bounds of one model's outputs in some coordinates."""

    def __init__(self, templates: Templates, frames: Frames) -> None:
        self.templates, self.model, self.frames = templates, templates.model, dict(frames)
        level, floor = float(self.model.level), float(self.model.floor)
        self._f_units = (1.0, level / floor if level and floor else 1.0)
        self._inverse = {name: np.linalg.inv(T) for name, T in self.frames.items()}
        self._whole = [self._frame(index) for index in range(len(self.model.locations))]
        noise = np.linalg.norm(floats(self.model.loop.weight * self.model.bounds.columns), axis=0)
        self._noise_units = (floor or level or 1.0) / np.maximum(noise, 1e-12)

    def solve(
        self, output: str, decay: float, *, starts: bool, margin: float, accuracy: Accuracy
    ) -> Found | None:
        """Return the smallest bound of an output for a ν: from the start on, or in the limit.

        Minimised is D₁² + D₂² from the start on, and D₂² in the limit. D₂ of an output weighs more: it
        decides from when on the output is within its allowed error. D₁ and D₂ of the drift are divided
        by the thresholds c and f of their units: the time between events depends on these quotients.
        """
        size = self._output_size(output)
        problem = [self._scaled(item, size) for item in self.templates.at(decay, output, starts=starts)]
        units = _units(problem)
        weights = self._weights(output, starts=starts)
        objective = {name: weight * units[name] for name, weight in weights.items() if name in units}
        largest = max(objective.values())
        objective = {name: w / largest for name, w in objective.items()}
        solution = _solved(objective, problem, units, margin, accuracy)
        if not solution.is_solved:
            return None
        found = self._unscaled(solution, size, units)
        squares = (weights[name] * max(found.numbers.get(name, 0.0), 0.0) for name in weights)
        return found._replace(size=sum(squares) ** 0.5)

    def shortfall(self, output: str, decay: float, *, starts: bool, accuracy: Accuracy) -> Shortfall | None:
        """Return which inequality is missed by most if the sum of all shortfalls is as small as possible.

        The inequalities of the output are met: they say how large V is. None: the solver fails.
        """
        size = self._output_size(output)
        items = self.templates.at(decay, output, starts=starts)
        problem, names = [], {}
        for item in items:
            scaled = self._scaled(item, size)
            if not item.name.startswith("output/"):
                names[f"{_SHORT}{item.name}"] = item.name
                slack = f"{_SHORT}{item.name}", np.eye(len(scaled.constant))
                scaled = scaled._replace(scalars=(*scaled.scalars, slack))
            problem.append(scaled)
        units = _units(problem)
        levels = {name: _LEVEL_WEIGHT for name in self._weights(output, starts=starts) if name in units}
        solution = _solved({**dict.fromkeys(names, 1.0), **levels}, problem, units, 0.0, accuracy)
        if not solution.is_solved:
            return None
        worst = max(names, key=lambda name: solution.numbers[name])
        return Shortfall(names[worst], solution.numbers[worst])

    def _weights(self, output: str, *, starts: bool) -> Mapping[str, float]:
        """Return the weights of D₁² and D₂²."""
        if not starts:
            return {"level 1": 1e-6, "level 2": 1.0}
        level, floor = float(self.model.level), float(self.model.floor)
        if output in _OF_THRESHOLDS and level and floor and not self.model.is_by_tests:
            return {"level 1": floor / level, "level 2": level / floor}
        return {"level 1": 1.0, "level 2": _CONSTANT_WEIGHT if output.startswith("y[") else 1.0}

    def _output_size(self, output: str) -> float:
        index = min(1, len(self.model.locations) - 1)
        place = self.model.locations[index]
        rows = floats(self.model.output(output, place)[0][0])[:, list(place.coordinates)]
        return float(np.linalg.norm(rows @ self._whole[index])) or 1.0

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
        if (memory := floats(self.model.y)).any():
            at = place.coordinates.index(int(np.flatnonzero(memory[0])[0]))
            frame[at, at] = self.frames[MEMORY][0, 0]
        for name, S in form.parts:
            where = [int(np.flatnonzero(row)[0]) for row in floats(S)]
            frame[np.ix_(where, where)] = self.frames[name]
        return frame

    def _scaled(self, item: Template, size: float) -> MatrixInequality:
        parts = tuple(
            (name, self._inverse[name] @ left, self._inverse[name] @ right)
            for name, left, right in item.parts
        )
        result = MatrixInequality(parts, item.scalars, item.constant / size**2)
        if self.model.is_by_tests and parts:  # some consist of small differences only
            largest = max(float(np.abs(left).max() * np.abs(right).max()) for _, left, right in parts)
            result = result.scaled(1 / largest)
        frame = np.eye(1) if item.signals < 0 else self._whole[item.location]
        whole, first = np.eye(len(item.constant)), len(frame)
        whole[:first, :first] = frame
        if len(whole) > first + max(item.signals, 0):
            noise = range(first, first + len(self._noise_units))
            whole[noise, noise] = self._noise_units
        if not parts:  # a silent test: w is in no term, but the frame mixes it with e
            kept = np.eye(len(whole))[:, _occurring(result, np.eye(len(whole)))]
            return result.within(kept @ np.linalg.qr(whole.T @ kept).R.T)
        return result.within(whole[:, _occurring(result, whole)])

    def _unscaled(self, solution: SolverAnswer, size: float, units: Mapping[str, float]) -> Found:
        matrices = {}
        for name, V in solution.matrices.items():
            inverse = self._inverse[name]
            matrices[name] = size**2 * inverse.T @ V @ inverse
        numbers = {name: size**2 * units[name] * value for name, value in solution.numbers.items()}
        return Found(matrices, numbers, 0.0)


def _solved(
    objective: Mapping[str, float],
    problem: list[MatrixInequality],
    units: Mapping[str, float],
    margin: float,
    accuracy: Accuracy,
) -> SolverAnswer:
    """Return the solver's answer, with numbers in their units."""
    problem = [
        item._replace(scalars=tuple((name, units[name] * M) for name, M in item.scalars)) for item in problem
    ]
    free = {name for name in units if name.startswith(FREE)}
    return minimise(objective, problem, free=free, margin=margin, accuracy=accuracy)


def refined(frames: Frames, found: Found) -> Frames:
    """Return the coordinates in which the matrices of a solution are of order 1."""
    scale = max(float(np.hypot(*found.levels)), 1e-150)
    better = dict(frames)
    for name, V in found.matrices.items():
        T = frames[name]
        values, vectors = np.linalg.eigh(T.T @ V @ T)
        if values[-1] > 0:
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
