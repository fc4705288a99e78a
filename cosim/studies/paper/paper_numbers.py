"""The format of numbers, shares and quartiles on the page."""

import math

from cosim.studies.campaign.draw_statistics import quartiles
from noack.core.linear_systems import Vector

HORIZON_S = 40.0
"""Horizon of the campaign ``paper``; a time beyond it is written as "> 40"."""


_SMALL, _LARGE = 1e-3, 1e6
"""Numbers outside these limits are written with a power of ten."""


def number(value: float, digits: int = 3) -> str:
    """Return a number as text: 0.0123, 517, 2.8 · 10³³."""
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
    """Return a share in percent; only exactly all or none is written as 100 % or 0 %."""
    if value in (0.0, 1.0):
        return f"{100 * value:.0f} %"
    text = f"{100 * value:.0f}"
    return f"{100 * value:.1f} %" if text in ("0", "100") else f"{text} %"


def spread(values: Vector, digits: int = 3) -> str:
    """Return median and quartiles: 517 (493 … 547)."""
    low, middle, high = quartiles(values)
    return f"{number(middle, digits)} ({number(low, digits)} … {number(high, digits)})"


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
