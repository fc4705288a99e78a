"""A mean and the half-width of its interval, with the digits that the interval leaves."""

import math
from decimal import Decimal

_DIGITS = 2
"""Of the half-width."""
_ALONE = 4
"""Of a mean without an interval, or with one of another order of magnitude than is written out."""
_FIXED = range(-5, 7)
"""Powers of ten that are written out."""


def plus_minus(mean: float, halfwidth: float) -> str:
    """Write ``mean ± halfwidth``; the mean alone where there is no interval.

    The half-width has two digits, the mean as many places: ``0.1594 ± 0.016`` is ``0.159 ± 0.016``.
    """
    if not (math.isfinite(mean) and math.isfinite(halfwidth) and halfwidth > 0):
        return f"{mean:.{_ALONE}g}".replace("-", "−")
    last = _power(float(f"{halfwidth:.{_DIGITS - 1}e}")) - _DIGITS + 1
    if last + _DIGITS - 1 not in _FIXED or _power(mean) not in _FIXED:
        return f"{mean:.{_ALONE}g} ± {halfwidth:.{_DIGITS}g}".replace("-", "−")
    return f"{_rounded(mean, last)} ± {_rounded(halfwidth, last)}".replace("-", "−")


def _power(number: float) -> int:
    return math.floor(math.log10(abs(number))) if number else 0


def _rounded(number: float, last: int) -> str:
    """Round to a multiple of 10^last, which is the last digit that is written."""
    rounded = Decimal(repr(number)).quantize(Decimal(1).scaleb(last)) + 0  # no −0
    return f"{rounded:.{max(-last, 0)}f}"
