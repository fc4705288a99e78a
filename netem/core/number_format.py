"""Formats numbers for tables and messages, and rows of texts for a terminal and a notebook.

Numbers have units, significant digits, and intervals.
"""

import html
import math
import unicodedata
from collections.abc import Sequence
from decimal import MAX_EMAX, MIN_EMIN, ROUND_CEILING, ROUND_FLOOR, Context, Decimal

NONE = "-"
"""Text for a missing number."""
_HALFWIDTH_DIGITS = 2  # significant digits of the half-width
_MEAN_DIGITS = 4
"""Significant digits of a mean without an interval, or with an interval in exponent notation."""
_BOUND_DIGITS = 12
"""Significant digits of a bound that are used; later ones are rounding errors."""
_WIDE_CONTEXT = Context(prec=400, Emin=MIN_EMIN, Emax=MAX_EMAX)
_FIXED_POWERS = range(-5, 7)  # powers of ten that are written without exponent notation
_TIME_DIGITS = 3
"""Significant digits of a duration."""
_UNIT_SIZES = (1e9, 1e6, 1e3)
TextRows = Sequence[Sequence[str]]
"""The first entry of a row is its name."""
_CELL = 'style="text-align: left; vertical-align: top; line-height: 1.4"'
"""At the cells, since the style sheets of notebooks align the text of each cell."""


def counted(count: int, noun: str) -> str:
    """Write a number of things: ``1 datagram``, ``2,000 datagrams``."""
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def number(value: float | None, digits: int = 3) -> str:
    """Write a number with ``digits`` significant digits."""
    return NONE if value is None or math.isnan(value) else f"{value:.{digits}g}"


def to_digits(value: float, digits: int = 3) -> float:
    """Return a number rounded to ``digits`` significant digits."""
    return float(f"{value:.{digits}g}")


def at_most(value: float | None, digits: int = 4, decimals: int | None = None) -> str:
    """Write an upper bound, rounded up to ``digits`` significant digits, or to ``decimals``."""
    return _bound(value, digits, decimals, ROUND_CEILING)


def at_least(value: float | None, digits: int = 4, decimals: int | None = None) -> str:
    """Write a lower bound, rounded down to ``digits`` significant digits, or to ``decimals``."""
    return _bound(value, digits, decimals, ROUND_FLOOR)


def _bound(value: float | None, digits: int, decimals: int | None, rounding: str) -> str:
    if value is None or value == 0 or not math.isfinite(value):
        return number(value, digits)
    exact = Decimal(f"{value:.{_BOUND_DIGITS}g}") if decimals is None else Decimal(value)
    last = exact.adjusted() - digits + 1 if decimals is None else -decimals
    rounded = exact.quantize(Decimal(1).scaleb(last), rounding, _WIDE_CONTEXT)
    return f"{float(rounded):.{digits}g}" if decimals is None else f"{rounded:.{decimals}f}"


def whole(value: float | None) -> str:
    """Write a number without decimals."""
    return NONE if value is None else f"{value:.0f}"


def seconds(value_s: float | None) -> str:
    """Write a time in seconds with three decimals."""
    return NONE if value_s is None else f"{value_s:.3f} s"


def duration(value_s: float) -> str:
    """Write a time with up to three digits, in s, ms, µs or ns."""
    return _without_zeros(with_unit(value_s * 1e9, ("s", "ms", "µs", "ns")))


_LONG_TIMES_S = (("years", 365.25 * 86400.0), ("days", 86400.0), ("h", 3600.0))


def long_duration(value_s: float) -> str:
    """Write a time as :func:`duration` does, from 1 h on with three digits in h, days or years."""
    for unit, length_s in _LONG_TIMES_S:
        if value_s >= length_s:
            return f"{number(value_s / length_s)} {unit}"
    return duration(value_s)


def availability_percent(unavailability: float) -> str:
    """Write 1 − ``unavailability`` in percent, with two digits behind its nines."""
    if not 0 < unavailability < 1:
        return f"{100 * (1 - unavailability):g} %"
    decimals = max(1 - math.floor(math.log10(100 * unavailability)), 2)
    exact = 100 - Decimal(f"{100 * unavailability:.3g}")
    return f"{exact.quantize(Decimal(1).scaleb(-min(decimals, 15)), ROUND_FLOOR, _WIDE_CONTEXT):f} %"


def duration_at_least(value_s: float) -> str:
    """Write a lower bound of a time as :func:`duration` does, rounded down."""
    return duration(float(at_least(value_s, _TIME_DIGITS)))


def byte_size(value: float) -> str:
    """Write a number of bytes with up to three digits, in GB, MB, kB or bytes."""
    return _without_zeros(with_unit(value, ("GB", "MB", "kB", "bytes")))


def ratio(part: int, of: int) -> str:
    """Write a share of a count in whole percent."""
    return f"{100 * part / of:.0f} %" if of else NONE


def percent(share: float) -> str:
    """Write a share in percent with one decimal; the smallest shares have no sign."""
    return f"{round(100 * share, 1) + 0.0:.1f} %"


def with_unit(value: float, units: tuple[str, str, str, str]) -> str:
    """Write a value with three digits in units of 10⁹, 10⁶, 10³ or 1."""
    for unit, size in zip(units, _UNIT_SIZES, strict=False):
        if abs(value) >= 0.9995 * size:
            part = abs(value) / size
            digits = 0 if part >= 99.95 else 1 if part >= 9.995 else 2
            return f"{value / size:.{digits}f} {unit}"
    return f"{value:.0f} {units[-1]}"


def _without_zeros(text: str) -> str:
    digits, unit = text.split()
    return f"{digits.rstrip('0').rstrip('.') if '.' in digits else digits} {unit}"


def plus_minus(mean: float, halfwidth: float) -> str:
    """Write ``mean ± halfwidth``; only the mean if there is no interval, or only that of rounding.

    The half-width has two significant digits. The mean has as many decimals as the half-width:
    ``0.1594 ± 0.016`` is ``0.159 ± 0.016``.
    """
    if not (math.isfinite(mean) and math.isfinite(halfwidth) and halfwidth > 10**-_BOUND_DIGITS * abs(mean)):
        return f"{mean:.{_MEAN_DIGITS}g}".replace("-", "−")
    last = _power(float(f"{halfwidth:.{_HALFWIDTH_DIGITS - 1}e}")) - _HALFWIDTH_DIGITS + 1
    if last + _HALFWIDTH_DIGITS - 1 not in _FIXED_POWERS or _power(mean) not in _FIXED_POWERS:
        return f"{mean:.{_MEAN_DIGITS}g} ± {halfwidth:.{_HALFWIDTH_DIGITS}g}".replace("-", "−")
    return f"{_rounded(mean, last)} ± {_rounded(halfwidth, last)}".replace("-", "−")


def _power(number: float) -> int:
    return math.floor(math.log10(abs(number))) if number else 0


def _rounded(number: float, last: int) -> str:
    """Round to a multiple of 10^last; this is the last written digit."""
    rounded = Decimal(repr(number)).quantize(Decimal(1).scaleb(last)) + 0  # no −0
    return f"{rounded:.{max(-last, 0)}f}"


def as_text(rows: TextRows) -> str:
    """Return rows as aligned columns."""
    widths = [max(map(_width, column)) for column in zip(*rows, strict=True)]
    lines = (
        "  ".join(entry + " " * (width - _width(entry)) for entry, width in zip(row, widths, strict=True))
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def as_html(rows: TextRows) -> str:
    """Return rows as an HTML table."""
    body = "".join(
        f'<tr><th scope="row" {_CELL}>{html.escape(name)}</th>'
        + "".join(f"<td {_CELL}>{html.escape(entry)}</td>" for entry in entries)
        + "</tr>"
        for name, *entries in rows
    )
    return f"<table>{body}</table>"


def _width(text: str) -> int:
    """Return the width of a text in columns; a combining character, as in δ̲, has width 0."""
    return sum(not unicodedata.combining(character) for character in text)
