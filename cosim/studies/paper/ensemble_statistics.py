"""Quartiles and shares of an ensemble, and how they are written."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.studies.paper.paper_conditions import HORIZON_S
from noack.core.linear_systems import Vector


class Quartiles(NamedTuple):
    """Each is the value of a draw, infinite ones included."""

    lower: float
    median: float
    upper: float


_SMALL, _LARGE = 1e-3, 1e6
"""Beyond these, numbers are written with a power of ten."""


def quartiles(values: Vector) -> Quartiles:
    """Lower quartile, median, upper quartile."""
    found = np.quantile(values, (0.25, 0.5, 0.75), method="inverted_cdf")
    return Quartiles(*(float(value) for value in found))


def paired(first: Vector, second: Vector) -> Vector:
    """``second`` − ``first`` draw by draw; 0 where neither happens within the horizon."""
    with np.errstate(invalid="ignore"):
        difference = second - first
    return np.where(np.isnan(difference), 0.0, difference)


def share(holds: NDArray[np.bool_]) -> float:
    """Share of the draws in which something holds."""
    return float(np.mean(holds))


def number(value: float, digits: int = 3) -> str:
    """A number as a person reads it: 0.0123, 517, 2.8 · 10³³."""
    if not math.isfinite(value):
        return f"> {HORIZON_S:g}"
    if value == round(value) and abs(value) < _LARGE:
        return f"{value:,.0f}".replace("-", "−")
    if _SMALL <= abs(value) < _LARGE:
        short = float(f"{value:.{digits}g}")
        text = f"{short:,.0f}" if abs(short) >= 10**digits else f"{short:g}"
        return text.replace("-", "−")
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = f"10{str(int(exponent)).translate(_RAISED)}"
    mantissa = f"{float(mantissa):g}".replace("-", "−")
    return power if mantissa == "1" else f"{mantissa} · {power}"


def percent(value: float) -> str:
    """A share in percent; only what is all or nothing is written as 100 % or 0 %."""
    if value in (0.0, 1.0):
        return f"{100 * value:.0f} %"
    text = f"{100 * value:.0f}"
    return f"{100 * value:.1f} %" if text in ("0", "100") else f"{text} %"


def spread(values: Vector, digits: int = 3) -> str:
    """Median and quartiles: 517 (493 … 547)."""
    low, middle, high = quartiles(values)
    return f"{number(middle, digits)} ({number(low, digits)} … {number(high, digits)})"


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
