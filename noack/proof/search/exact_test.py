"""Tests a search's solution in balls, before a proof is written: all inequalities of the hybrid system."""

from collections.abc import Mapping
from typing import TypeVar

from flint import arb, arb_mat

from noack.core.balls import is_positive, transpose
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.hybrid_system import Inequality, Model

_Value = TypeVar("_Value", arb, arb_mat)


def verify(
    model: Model,
    output: str,
    matrices: Mapping[str, arb_mat],
    numbers: Mapping[str, arb],
    *,
    starts: bool,
) -> None:
    """Prove |C z|² ≤ D₁² f₁² + D₂² f₂² for all runs of a model, D the numbers "level 1" and "level 2".

    Args:
        model: the loop as a hybrid system, with r and ν.
        output: its name, see :meth:`Model.output`.
        matrices: the symmetric matrices of the quadratic forms.
        numbers: their other numbers, the multipliers and the levels.
        starts: from the start of the run on; else for the limit t → ∞.

    Raises:
        RejectedError: it is not proven.
    """
    if not model.decay > 2 * model.rate:
        raise RejectedError("ν is not above 2r")
    for name, value in numbers.items():
        if name.startswith(("m/", "a/", "level")) and not value >= 0:
            raise RejectedError(f"{name} is negative")
    for item in model.inequalities(output, starts=starts):
        if not is_positive(_value(item, matrices, numbers)):
            raise RejectedError(item.name)


def _value(item: Inequality, matrices: Mapping[str, arb_mat], numbers: Mapping[str, arb]) -> arb_mat:
    """Return the matrix of an inequality."""
    total = item.constant
    for name, left, right in item.parts:
        V = _entry(matrices, name)
        if not (V.nrows() == V.ncols() == left.nrows() and transpose(V) == V):
            raise RejectedError(f"{name} is not a symmetric ({left.nrows()}, {left.nrows()})")
        product = transpose(left) * V * right
        total = total + product + transpose(product)
    for name, M in item.scalars:
        total = total + _entry(numbers, name) * M
    return total


def _entry(values: Mapping[str, _Value], name: str) -> _Value:
    if name not in values:
        raise RejectedError(f"{name} is missing")
    return values[name]
