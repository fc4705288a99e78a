"""A plant's equations as the steps that the checker reads.

The equations are called with numbers that note what is done with them, on a region: which case of a
comparison holds there becomes a step that the checker verifies. Each step is enclosed at once, by
:mod:`noack_equations`, which has the argument.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from netem.core.errors import NoackError, one_line, shortened
from noack.core.balls import number
from noack.core.linear_systems import Vector
from noack.plants.plant_settings import PlantSystem
from noack.plants.systems.equation_text import formulas
from noack_equations import (
    SIGNALS,
    Enclosed,
    Evaluation,
    LinearPlants,
    Region,
    RejectedError,
    UndefinedError,
    enclose,
)

Operand: TypeAlias = "TracedNumber | float"
_MOST_SIGNALS = 16
_FUNCTIONS = ("sin", "cos", "tan", "arctan", "tanh", "sinh", "cosh", "exp", "log", "sign")
_NUMPY = {name: name for name in _FUNCTIONS} | {"absolute": "abs", "fabs": "abs"}
_OPERATORS = {
    "add": "__add__", "subtract": "__sub__", "multiply": "__mul__", "divide": "__truediv__",
    "true_divide": "__truediv__", "power": "__pow__", "float_power": "__pow__", "less": "__lt__",
    "less_equal": "__le__", "greater": "__gt__", "greater_equal": "__ge__",
}  # fmt: skip
_KNOWN_FUNCTIONS = f"{', '.join(_FUNCTIONS)}, sqrt, hypot, abs, clip, minimum, maximum, radians and degrees"


class NotEnclosedError(NoackError):
    """The equations have no enclosure over a region; the message is the reason."""


class TracedEquations(NamedTuple):
    """Equations on a region."""

    document: Mapping[str, object]
    """Their steps, as :func:`noack_equations.enclose` reads them."""
    plants: LinearPlants
    """What encloses them."""


class TracedNumber:
    """The result of a step. Its trace has all steps before it."""

    __slots__ = ("_trace", "index")

    def __init__(self, trace: "_Trace", index: int) -> None:
        self._trace, self.index = trace, index

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: object) -> Any:
        """Return a function of numpy."""
        _require_no_options(ufunc.__name__, options)
        if any(isinstance(value, np.ndarray) and value.ndim for value in inputs):
            return ufunc(*(np.asarray(value, dtype=object) for value in inputs))  # entry by entry
        operands = [value.item() if isinstance(value, np.ndarray) else value for value in inputs]
        name = ufunc.__name__
        if method != "__call__":
            raise NotEnclosedError(f"np.{name}.{method} has no enclosure")
        if name in _OPERATORS:
            first, second = (self._trace.traced(value) for value in operands)
            return getattr(first, _OPERATORS[name])(second)
        return getattr(self._trace.traced(operands[0]), name)(*operands[1:])

    def __add__(self, other: Operand) -> "TracedNumber":
        if _is_array(other):
            return NotImplemented  # entry by entry
        return self if _is(other, 0) else self._step("add", other)

    __radd__ = __add__

    def __neg__(self) -> "TracedNumber":
        return self._step("negative")

    def __pos__(self) -> "TracedNumber":
        return self

    def __sub__(self, other: Operand) -> "TracedNumber":
        if _is_array(other):
            return NotImplemented
        return self if _is(other, 0) else self + (-other)

    def __rsub__(self, other: Operand) -> "TracedNumber":
        return -self + other

    def __mul__(self, other: Operand) -> "TracedNumber":
        if _is_array(other):
            return NotImplemented
        if isinstance(other, TracedNumber) and other.index == self.index:
            return self**2
        return self if _is(other, 1) else self._step("times", other)

    __rmul__ = __mul__

    def __truediv__(self, other: Operand) -> "TracedNumber":
        if _is_array(other):
            return NotImplemented
        return self * self._trace.traced(other) ** -1

    def __rtruediv__(self, other: float) -> "TracedNumber":
        return self**-1 * other

    def __pow__(self, exponent: Operand) -> "TracedNumber":
        if isinstance(exponent, TracedNumber):
            raise NotEnclosedError("a power has an enclosure if its exponent is a number")
        if exponent == 0.5:
            return self.sqrt()
        return self if exponent == 1 else self._trace.add("power", [self], [float(exponent)])

    def __abs__(self) -> "TracedNumber":
        return self._step("abs")

    def __lt__(self, other: Operand) -> bool:
        return self._trace.decides(self._trace.traced(other) - self, self - other)

    def __ge__(self, other: Operand) -> bool:
        return not self < other

    def __gt__(self, other: Operand) -> bool:
        return self._trace.decides(self - other, self._trace.traced(other) - self)

    def __le__(self, other: Operand) -> bool:
        return not self > other

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TracedNumber | float | int):
            return NotImplemented
        return not (self < other or self > other)

    __hash__ = None  # type: ignore[assignment] # == may be undecided, so no hash agrees with it

    def __bool__(self) -> bool:
        return not self == 0  # noqa: SIM201 # __ne__ would be another comparison

    def __float__(self) -> float:
        """Refuse to become a float: nothing would be known about it on a region."""
        raise TypeError(
            "its equations make a float of a state; use the states as they are, and functions of numpy"
        )

    def __getattr__(self, name: str) -> Callable[..., "TracedNumber"]:
        """Return a function of numpy, or refuse it by its name."""
        if name.startswith("_"):  # numpy also asks for protocols
            raise AttributeError(name)
        if name in _NUMPY:
            return lambda: self._step(_NUMPY[name])

        def refuse(*_: object) -> "TracedNumber":
            raise NotEnclosedError(f"np.{name} has no enclosure; {_KNOWN_FUNCTIONS} have one")

        return refuse

    def sqrt(self) -> "TracedNumber":
        """See :func:`numpy.sqrt`."""
        return self._step("root")

    def hypot(self, other: Operand) -> "TracedNumber":
        """See :func:`numpy.hypot`."""
        return (self**2 + self._trace.traced(other) ** 2).sqrt()

    def radians(self) -> "TracedNumber":
        """See :func:`numpy.radians`."""
        return self * (np.pi / 180)

    def degrees(self) -> "TracedNumber":
        """See :func:`numpy.degrees`."""
        return self * (180 / np.pi)

    deg2rad, rad2deg = radians, degrees

    def square(self) -> "TracedNumber":
        """See :func:`numpy.square`."""
        return self**2

    def negative(self) -> "TracedNumber":
        """See :func:`numpy.negative`."""
        return -self

    def copysign(self, other: Operand) -> "TracedNumber":
        """See :func:`numpy.copysign`."""
        return abs(self) * self._trace.traced(other).sign()

    def maximum(self, other: Operand) -> "TracedNumber":
        """See :func:`numpy.maximum`."""
        if isinstance(other, TracedNumber):
            return other + (self - other).clip(0.0, None)
        return self.clip(other, None)

    def minimum(self, other: Operand) -> "TracedNumber":
        """See :func:`numpy.minimum`."""
        if isinstance(other, TracedNumber):
            return other + (self - other).clip(None, 0.0)
        return self.clip(None, other)

    def clip(
        self, low: float | None = None, high: float | None = None, out: None = None, **options: object
    ) -> "TracedNumber":
        """See :func:`numpy.clip`; the limits are numbers."""
        _require_no_options("clip", {"out": out, **options})
        sides = ((low, -np.inf), (high, np.inf))
        limits = [None if end is None or end == nothing else float(end) for end, nothing in sides]
        return self._trace.add("clip", [self], limits)

    def _step(self, name: str, *others: Operand) -> "TracedNumber":
        return self._trace.add(name, [self, *map(self._trace.traced, others)])


def _require_no_options(name: str, options: Mapping[str, object]) -> None:
    """Refuse what numpy would do with a result, such as to write it into an array."""
    if used := [key for key, value in options.items() if value is not None and value is not True]:
        raise NotEnclosedError(f"np.{name} has no enclosure with {', '.join(used)}")


def _is_array(value: object) -> bool:
    return isinstance(value, np.ndarray)


def _is(value: Operand, constant: int) -> bool:
    return not isinstance(value, TracedNumber) and value == constant


class _Trace:
    """The steps so far, with their enclosures over a region."""

    def __init__(self, region: Region, signals: int) -> None:
        self.evaluation, self._signals = Evaluation(region, signals), 0
        self.steps = list[list[str | int | float | None]]()
        self.enclosed = list[Enclosed]()
        self._known = dict[tuple[object, ...], int]()

    def add(
        self, name: str, operands: Sequence[TracedNumber] = (), numbers: Sequence[float | None] = ()
    ) -> TracedNumber:
        indices = [operand.index for operand in operands]
        key = (name, *indices, *numbers)
        if key not in self._known:
            self._signals += name in SIGNALS
            if self._signals > _MOST_SIGNALS:
                raise NotEnclosedError(
                    f"its equations have more than {_MOST_SIGNALS} of {', '.join(SIGNALS)}"
                )
            try:
                self.enclosed.append(
                    self.evaluation.step(name, [self.enclosed[index] for index in indices], numbers)
                )
            except UndefinedError as error:
                [text] = formulas({"steps": self.steps, "rates": indices[:1]})
                raise NotEnclosedError(f"{error}: {shortened(text)}") from None
            except RejectedError as error:
                raise NotEnclosedError(str(error)) from None
            self.steps.append([name, *indices, *numbers])
            self._known[key] = len(self.steps) - 1
        return TracedNumber(self, self._known[key])

    def traced(self, value: Operand) -> TracedNumber:
        return value if isinstance(value, TracedNumber) else self.add("number", numbers=[float(value)])

    def decides(self, difference: TracedNumber, opposite: TracedNumber) -> bool:
        """Return whether a difference is above 0, where this or its opposite is proven."""
        try:
            self.add("positive", [difference])
        except NotEnclosedError:
            self.add("nonnegative", [opposite])
            return False
        return True

    def is_coordinate(self, value: object, index: int) -> bool:
        """Return whether a number is the entry of z, plus a constant that is 0 but for rounding."""
        if not isinstance(value, TracedNumber):
            return False
        term = self.enclosed[value.index]
        is_unit = all(slope == int(k == index) for k, slope in enumerate(term.slopes))
        return is_unit and bool(term.rest == 0)


def trace(system: PlantSystem, n: int, m: int, widths: Vector, *, signals: bool = True) -> TracedEquations:
    """Return the equations of a plant at x = 0, on the region |(x, u)_k| ≤ ``widths``, (n + m,).

    Infinite widths are possible. Without ``signals`` the plants that enclose the equations have no unknown
    signals.

    Raises:
        NotEnclosedError: it has no equations, or they have no enclosure.
    """
    if not hasattr(system, "expressions"):
        raise NotEnclosedError("it has no equations that can be enclosed: it moves by itself")
    limits = [None if np.isinf(width) else number(float(width)) for width in widths]
    region = Region(tuple(limits[:n]), tuple(limits[n:]))
    log = _Trace(region, _MOST_SIGNALS if signals else 0)
    x = np.array([log.add("state", numbers=[i]) for i in range(n)], dtype=object)
    u = np.array([log.add("input", numbers=[j]) for j in range(m)], dtype=object)
    try:
        expressions = system.expressions(log.add("time"), x, u)
    except TypeError as error:  # of an extension that uses math.sin
        raise NotEnclosedError(f"its equations are for floats alone: {one_line(error)}") from None
    except NotEnclosedError:
        raise
    except NoackError as error:  # of a user's class that uses it
        raise NotEnclosedError(str(error)) from None
    if expressions is None:
        raise NotEnclosedError("x is neither its state nor its state minus a constant")
    rates, states = expressions
    if not all(log.is_coordinate(state, i) for i, state in enumerate(states)):
        raise NotEnclosedError("x is not its state minus a constant")
    indices = [log.traced(rate).index for rate in rates]
    document = {"steps": log.steps, "rates": indices}
    try:
        if not signals:
            return TracedEquations(document, log.evaluation.plants([log.enclosed[i] for i in indices]))
        return TracedEquations(document, enclose(document, region))
    except RejectedError as error:
        raise NotEnclosedError(str(error)) from None
