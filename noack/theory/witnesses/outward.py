"""What was proven, as floats that are rounded outwards."""

import math
from decimal import MAX_EMAX, MIN_EMIN, ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from fractions import Fraction

from flint import arb, fmpq

from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.noise import noise_of
from noack.proof.search.results import Proof, smallest_bounds
from noack.theory.certificates.proven_bounds import ProvenBound, ProvenBounds
from noack.theory.witnesses.effort import NoWitnessError

_DIGITS = 12
"""Significant digits: tables round decimals of this length, and stay true."""


def proven_bounds(proof: Proof, loop: Loop) -> ProvenBounds:
    """Return the bounds of a proof; of two bounds of the same output the smaller one.

    The errors of certificates and records are about the measured or estimated x + n; those of proofs are
    about x.

    Raises:
        NoWitnessError: a number is too large for a float.
    """
    noise = noise_of(loop, proof.rate).sizes
    bounds, limits = dict[str, ProvenBound](), dict[str, float]()
    for bound in smallest_bounds(proof):
        if bound.from_start:
            added = noise if bound.output.startswith("e_") else (arb(0), arb(0))
            decaying, constant = bound.decaying + added[0], bound.constant + added[1]
            bounds[bound.output] = ProvenBound(above(decaying), above(constant))
        else:
            limits[bound.output] = above(bound.constant)
    if loop.observer is not None or loop.noise.ncols():
        bounds["estimate"] = ProvenBound(*map(above, noise))
    if not loop.outputs.nrows():  # they are the states
        bounds = {f"y{name[1:]}": bound for name, bound in bounds.items() if name.startswith("x[")} | bounds
    apart_s, first_s = (
        None if t is None else below(t) or None for t in (proof.inter_event, proof.first_event)
    )
    return ProvenBounds(below(proof.rate), bounds, limits, apart_s, first_s, proof.is_quiet)


def above(value: arb) -> float:
    """Return a float of twelve digits that is at least a number, which is not negative."""
    found, exact = _rounded(_exact(value.upper()), ROUND_CEILING)
    return math.nextafter(found, math.inf) if Fraction(found) < exact else found


def below(value: arb | fmpq) -> float:
    """Return a float of twelve digits that is at most a number; 0 for one that may be negative."""
    least = value if isinstance(value, fmpq) else _exact(value.lower().max(arb(0)))
    found, exact = _rounded(least, ROUND_FLOOR)
    return math.nextafter(found, -math.inf) if Fraction(found) > exact else found


def _exact(value: arb) -> fmpq:
    if not math.isfinite(float(value)):
        raise NoWitnessError("a bound is too large for floating point")
    return value.fmpq()


def _rounded(value: fmpq, rounding: str) -> tuple[float, Fraction]:
    exact = Fraction(int(value.p), int(value.q))
    if exact == Fraction(short := float(f"{float(value):.{_DIGITS}g}")):
        return short, exact
    context = Context(prec=_DIGITS, rounding=rounding, Emin=MIN_EMIN, Emax=MAX_EMAX)
    return float(context.divide(Decimal(exact.numerator), Decimal(exact.denominator))), exact
