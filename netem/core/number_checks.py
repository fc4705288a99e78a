"""Checks of the numbers that a user gives, by an option of a command or an argument of the library.

The option and the argument have the same name, and so the same line: ``late -1: expected at least 0``.
"""

from collections.abc import Iterable
from math import isnan
from numbers import Integral, Real

from netem.core.errors import CallerError, one_line, shortened


def whole_number(name: str, value: object, least: int, most: int | None = None) -> int:
    """Return a whole number, also one of NumPy.

    Args:
        name: of the option and the argument, for the message.
        value: what the user gave.
        least: smallest number allowed.
        most: largest number allowed.

    Raises:
        CallerError: it is none, or is out of range.
    """
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise _wrong(name, value, "a whole number")
    number = int(value)
    _require_range(name, value, number, least, most)
    return number


def real_number(
    name: str,
    value: object,
    *,
    above: float | None = None,
    most: float | None = None,
) -> float:
    """Return a number, also one of NumPy, as :func:`whole_number` does; it must be more than ``above``."""
    if isinstance(value, bool) or not isinstance(value, Real) or isnan(value):
        raise _wrong(name, value, "a number")
    number = float(value)
    if above is not None and not number > above:
        raise _wrong(name, value, f"more than {above:g}")
    _require_range(name, value, number, None, most)
    return number


def one_of(name: str, value: object, choices: Iterable[str]) -> None:
    """Raise CallerError unless a value is one of some texts."""
    known = tuple(choices)
    if value not in known:
        quoted = ", ".join(f"'{choice}'" for choice in known)
        raise CallerError(f"{name} {_text(value)}: '{_text(value)}' is not one of {quoted}")


def _require_range(name: str, value: object, number: float, least: float | None, most: float | None) -> None:
    if least is not None and number < least:
        raise _wrong(name, value, f"at least {_limit(least)}")
    if most is not None and number > most:
        raise _wrong(name, value, f"at most {_limit(most)}")


def _limit(value: float) -> str:
    return f"{value}" if isinstance(value, int) else f"{value:g}"


def _wrong(name: str, value: object, expected: str) -> CallerError:
    return CallerError(f"{name} {_text(value)}: expected {expected}")


def _text(value: object) -> str:
    return shortened(f"{value:g}" if isinstance(value, float) else one_line(str(value)))
