"""The inequalities of a loop's model in floating point, for any ν: made once, since they are affine in it."""

from collections.abc import Callable, Iterable
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix
from noack.proof.elaborate.hybrid_system import Inequality, MatrixPart, Model
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.problem_size import work_of

_LOW, _HIGH = 1.0, 2.0


class Template(NamedTuple):
    """An inequality as :class:`noack.proof.elaborate.hybrid_system.Inequality`, in floating point."""

    name: str
    location: int
    signals: int
    parts: tuple[tuple[str, Matrix, Matrix], ...]
    scalars: tuple[tuple[str, Matrix], ...]
    constant: Matrix


class Templates:
    """All inequalities of a loop.

    Args:
        make: returns the model for a ν.
    """

    def __init__(self, make: Callable[[float], Model]) -> None:
        self.model = make(_LOW)
        self._low = [_template(item) for item in self.model.common_inequalities()]
        flows = takewhile(lambda item: item.name.startswith("flow/"), make(_HIGH).common_inequalities())
        self._high = [_template(item) for item in flows]
        self._outputs: dict[str, list[Template]] = {}

    def at(self, decay: float, output: str, *, starts: bool) -> list[Template]:
        """Return the inequalities that bound an output: see :meth:`.hybrid_system.Model.inequalities`."""
        if output not in self._outputs:
            self._outputs[output] = [_template(item) for item in self.model.output_inequalities(output)]
        share = (decay - _LOW) / (_HIGH - _LOW)
        pairs = zip(self._low, self._high, strict=False)
        flows = [_between(low, high, share) for low, high in pairs]
        start = [_template(self.model.start_inequality())] if starts else []
        return [*flows, *self._low[len(self._high) :], *self._outputs[output], *start]

    def work(self, output: str) -> float:
        """Return about how many 10⁹ products the solver needs per step to bound an output."""
        return work_of(len(item.constant) for item in self.at(_LOW, output, starts=False))


def _template(item: Inequality) -> Template:
    scalars = tuple((name, floats(M)) for name, M in item.scalars)
    return Template(
        item.name, item.location, item.signals, _merged(item.parts), scalars, floats(item.constant)
    )


def _merged(parts: Iterable[MatrixPart]) -> tuple[tuple[str, Matrix, Matrix], ...]:
    """Return parts of which no two have the same matrix V and the same left or right side, up to a factor."""
    found: list[tuple[str, Matrix, Matrix]] = []
    for part in parts:
        left, right = floats(part.left), floats(part.right)
        for index, (name, L, R) in enumerate(found):
            if name != part.name:
                continue
            for one, other in ((left, right), (right, left)):
                factor = _factor(one, L)
                if factor is not None:
                    found[index] = (name, L, R + factor * other)
                    break
            else:
                continue
            break
        else:
            found.append((part.name, left, right))
    return tuple(found)


def _factor(M: Matrix, unit: Matrix) -> float | None:
    """Return the factor by which a matrix differs from another one, or None."""
    factor = float((M * unit).sum() / (unit * unit).sum())
    return factor if np.abs(M - factor * unit).max() <= 1e-14 * np.abs(M).max() else None


def _between(low: Template, high: Template, share: float) -> Template:
    """Return low + share · (high − low)."""
    parts = tuple(
        (name, L, R + share * (other - R))
        for (name, L, R), (_, _, other) in zip(low.parts, high.parts, strict=True)
    )
    scalars = tuple(
        (name, M + share * (other - M))
        for (name, M), (_, other) in zip(low.scalars, high.scalars, strict=True)
    )
    return low._replace(parts=parts, scalars=scalars)
