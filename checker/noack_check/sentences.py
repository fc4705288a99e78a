"""What was proven, in words; decimals are rounded so that the sentences stay true."""

import json
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction
from math import isfinite

from flint import arb, fmpq

from noack_check.proof import Bound, Proof

_SHORT = 7
"""Longest decimal number that is printed as it is, if it stands for exactly that number."""


def quoted(name: str) -> str:
    """Return a name in quotes, in which it cannot end."""
    return json.dumps(name, ensure_ascii=False)


def smallest_bounds(proof: Proof) -> list[Bound]:
    """Return the bounds of a proof; of two bounds of the same output the smaller one.

    Left out is a limit that is not below what the bound from the start on tends to.
    """
    smallest: dict[tuple[str, bool], Bound] = {}
    for bound in proof.bounds:
        key = (bound.output, bound.from_start)
        if key not in smallest or size(bound) < size(smallest[key]):
            smallest[key] = bound
    return [
        bound
        for (output, from_start), bound in smallest.items()
        if from_start or not _limit_is_implied(bound, smallest.get((output, True)), proof.rate)
    ]


def _limit_is_implied(limit: Bound, bound: Bound | None, rate: arb) -> bool:
    return bound is not None and bool(rate > 0 and bound.constant <= limit.constant)


def size(bound: Bound) -> float:
    """Return the bound at t = 0, as it is printed, or what is left of one in the limit."""
    if not bound.from_start:
        return float(bound.constant.mid())
    return float((bound.decaying + bound.constant).mid())


def at_most(value: arb) -> str:
    """Return four digits of a number that is at least the value."""
    return _rounded(value.upper() if value.rad() != 0 else value, ROUND_CEILING)


def at_least(value: arb | fmpq) -> str:
    """Return four digits of a number that is at most the value."""
    if isinstance(value, fmpq):
        return _rounded(value, ROUND_FLOOR)
    return _rounded(value.lower() if value.rad() != 0 else value, ROUND_FLOOR)


def _rounded(value: arb | fmpq, rounding: str) -> str:
    exact, text = value if isinstance(value, fmpq) else value.mid().fmpq(), repr(float(value))
    if len(text) <= _SHORT and isfinite(float(value)):
        is_exact = arb(float(value)).fmpq() == exact or Fraction(text) == Fraction(int(exact.p), int(exact.q))
        if is_exact:
            return text
    context = Context(prec=4, rounding=rounding)
    return f"{context.divide(Decimal(int(exact.p)), Decimal(int(exact.q))):g}"
