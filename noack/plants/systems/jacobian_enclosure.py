"""A plant's equations, enclosed over a region: by a matrix of intervals, A x + B u.

Let z = (x, u), f(0) = 0, and |z_j| ≤ r_j. With the coordinates in any order, let z^j have those up
to z_j, and 0 for the others. By the fundamental theorem of calculus

    f(z) = Σ_j (f(z^j) − f(z^{j−1})) = Σ_j J_j z_j,    J_j = ∫₀¹ ∂f/∂z_j (z^{j−1} + s z_j e_j) ds

For s up to k/S the argument is in a box, with k/S r_j in direction j. So J_j is in the mean of the
enclosures of ∂f/∂z_j over S boxes. Each row of J may use another order. For z₁²z₂, J₂ = z₁² is of
second order if z₁ comes first; if it came last, J₁ = z₁z₂ would have to bear the large z₂. Several
orders are tried, and for each row the one with the smallest remainder is used
(docs/derivations.md, "Beyond linear plants").

∂f/∂z_j is computed from the equations themselves, with numbers that carry a value and derivatives
(forward differentiation), as balls of the library Arb, which rounds outward.
"""

import math
import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from noack.core.errors import NoackError, one_line
from noack.core.linear_systems import Matrix, Vector
from noack.plants.plant_settings import PlantSystem

if TYPE_CHECKING:
    from flint import arb

Operand: TypeAlias = "Enclosed | float"
_SLICES = 8
"""Parts of an interval over which a derivative is enclosed one by one: the enclosure becomes narrower."""
_NARROW = 1e-12
"""A derivative that varies by less than this share of itself is not divided into slices."""
_LONGEST_S = 1e9
"""The equations are enclosed for all times from 0 to this."""
_AT_REST = 1e-9
"""The plant rests if |f(0, 0)| is at most this share of the largest entry of A and B in its row."""
_UNDECIDED = "its equations distinguish cases, and the region contains more than one of them"
_KNOWN_FUNCTIONS = "sin, cos, tan, arctan, tanh, sinh, cosh, exp, log, sqrt and abs"


class NotEnclosedError(NoackError):
    """The derivatives have no enclosure over the region; the message is the reason."""


class Inclusion(NamedTuple):
    """f(x, u) = A x + B u with some A and B of this box, for every x and u of the region."""

    A: Matrix  # centre, (n, n)
    B: Matrix  # (n, m)
    halfwidth_A: Matrix
    halfwidth_B: Matrix


class Enclosed:
    """A number in an interval, with the intervals of its derivatives by each of x and u."""

    __slots__ = ("slopes", "value")

    def __init__(self, value: "arb", slopes: "Sequence[arb]") -> None:
        self.value, self.slopes = value, slopes

    def __add__(self, other: Operand) -> "Enclosed":
        if _is_array(other):
            return NotImplemented  # entry by entry
        if isinstance(other, Enclosed):
            slopes = [a + b for a, b in zip(self.slopes, other.slopes, strict=True)]
            return Enclosed(self.value + other.value, slopes)
        return Enclosed(self.value + float(other), self.slopes)

    __radd__ = __add__

    def __neg__(self) -> "Enclosed":
        return Enclosed(-self.value, [-slope for slope in self.slopes])

    def __sub__(self, other: Operand) -> "Enclosed":
        return self + (-other)

    def __rsub__(self, other: Operand) -> "Enclosed":
        return -self + other

    def __mul__(self, other: Operand) -> "Enclosed":
        if _is_array(other):
            return NotImplemented
        if not isinstance(other, Enclosed):
            return self._mapped(self.value * float(other), float(other))
        if other is self:
            return self**2
        pairs = zip(self.slopes, other.slopes, strict=True)
        slopes = [a * other.value + self.value * b for a, b in pairs]
        return Enclosed(self.value * other.value, slopes)

    __rmul__ = __mul__

    def __truediv__(self, other: Operand) -> "Enclosed":
        if _is_array(other):
            return NotImplemented
        if isinstance(other, Enclosed):
            return self * other**-1
        return self._mapped(self.value / float(other), 1 / _ball(float(other)))

    def __rtruediv__(self, other: float) -> "Enclosed":
        return self**-1 * other

    def __pow__(self, exponent: float) -> "Enclosed":
        power = float(exponent)
        if power == 0:
            return self._mapped(_ball(1.0), 0.0)
        return self._mapped(_power(self.value, power), power * _power(self.value, power - 1))

    def __abs__(self) -> "Enclosed":
        """Return |x|: where x may be 0, its slope is any from −1 to 1, as that of the chords of |x|."""
        if self.value >= 0:
            return self
        if self.value <= 0:
            return -self
        return self._mapped(_at_sizes(self.value, lambda x: x), _ball(0.0, 1.0))

    def __lt__(self, other: Operand) -> bool:
        return self._decided(operator.lt, operator.ge, other)

    def __le__(self, other: Operand) -> bool:
        return self._decided(operator.le, operator.gt, other)

    def __gt__(self, other: Operand) -> bool:
        return not self <= other

    def __ge__(self, other: Operand) -> bool:
        return not self < other

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Enclosed | float | int):
            return NotImplemented
        return not (self < other or self > other)

    __hash__ = None  # type: ignore[assignment] # == may be undecided, so no hash agrees with it

    def __bool__(self) -> bool:
        return not self == 0  # noqa: SIM201 # __ne__ would be another comparison

    def __float__(self) -> float:
        """Refuse to become a float, as the functions of ``math`` ask."""
        raise TypeError("a certificate on a region needs numpy's functions: np.sin, not math.sin")

    def __getattr__(self, name: str) -> Callable[..., "Enclosed"]:
        """Refuse a function of numpy that has no method here, by its name."""
        if name.startswith("_"):  # numpy also asks for protocols
            raise AttributeError(name)

        def refuse(*_: object) -> "Enclosed":
            raise NotEnclosedError(f"np.{name} has no enclosure; {_KNOWN_FUNCTIONS} have one")

        return refuse

    def sin(self) -> "Enclosed":
        """See :func:`numpy.sin`."""
        return self._mapped(self.value.sin(), self.value.cos())

    def cos(self) -> "Enclosed":
        """See :func:`numpy.cos`."""
        return self._mapped(self.value.cos(), -self.value.sin())

    def tan(self) -> "Enclosed":
        """See :func:`numpy.tan`."""
        return self.sin() / self.cos()

    def arctan(self) -> "Enclosed":
        """See :func:`numpy.arctan`."""
        return self._mapped(self.value.atan(), 1 / (1 + _power(self.value, 2)))

    def tanh(self) -> "Enclosed":
        """See :func:`numpy.tanh`; its slope 1/cosh² falls with |x|."""
        slope = _at_sizes(self.value, lambda x: x.sech() ** 2)
        return self._mapped(_at_ends(self.value, lambda x: x.tanh()), slope)

    def sinh(self) -> "Enclosed":
        """See :func:`numpy.sinh`."""
        slope = _at_sizes(self.value, lambda x: x.cosh())
        return self._mapped(_at_ends(self.value, lambda x: x.sinh()), slope)

    def cosh(self) -> "Enclosed":
        """See :func:`numpy.cosh`."""
        slope = _at_ends(self.value, lambda x: x.sinh())
        return self._mapped(_at_sizes(self.value, lambda x: x.cosh()), slope)

    def exp(self) -> "Enclosed":
        """See :func:`numpy.exp`."""
        value = _at_ends(self.value, lambda x: x.exp())
        return self._mapped(value, value)

    def log(self) -> "Enclosed":
        """See :func:`numpy.log`."""
        return self._mapped(self.value.log(), 1 / self.value)

    def sqrt(self) -> "Enclosed":
        """See :func:`numpy.sqrt`."""
        return self**0.5

    def _mapped(self, value: "arb", slope: "arb | float") -> "Enclosed":
        """Return the value of a function here, by the chain rule."""
        return Enclosed(value, [slope * own_slope for own_slope in self.slopes])

    def _decided(
        self,
        holds: Callable[["arb", "arb"], bool],
        fails: Callable[["arb", "arb"], bool],
        other: Operand,
    ) -> bool:
        limit = other.value if isinstance(other, Enclosed) else _ball(float(other))
        if holds(self.value, limit):  # for all numbers of both intervals
            return True
        if fails(self.value, limit):
            return False
        raise NotEnclosedError(_UNDECIDED)


def _is_array(value: object) -> bool:
    return isinstance(value, np.ndarray)


def _ball(middle: float, radius: float = 0.0) -> "arb":
    from flint import arb

    return arb(middle, radius)


def _power(value: "arb", power: float) -> "arb":
    """Enclose xᵖ: it is monotonic, or a monotonic function of |x|."""
    if power < 0:
        return 1 / _power(value, -power)
    at = _at_sizes if power % 2 == 0 else _at_ends
    return at(value, lambda x: _power_of_number(x, power))


def _at_ends(value: "arb", function: "Callable[[arb], arb]") -> "arb":
    """Enclose a monotonic function of x: between its values at the ends of the interval."""
    return function(value.lower()).union(function(value.upper()))


def _at_sizes(value: "arb", function: "Callable[[arb], arb]") -> "arb":
    """Enclose a monotonic function of |x|."""
    return function(value.abs_lower()).union(function(value.abs_upper()))


def _power_of_number(value: "arb", power: float) -> "arb":
    if power == 0.5:  # the square root
        return value.sqrt()
    if power % 1:
        return (value.log() * power).exp()
    return value ** int(power)


@dataclass(frozen=True)
class EnclosedMotion:
    """The equations of a plant at x = 0, with n states and m inputs, and their enclosures.

    Raises:
        NotEnclosedError: it has no equations that can be enclosed.
    """

    system: PlantSystem
    n: int
    m: int

    def __post_init__(self) -> None:
        if not hasattr(self.system, "expressions"):
            raise NotEnclosedError("it has no equations that can be enclosed: it moves by itself")

    def over(self, halfwidths: Vector) -> Inclusion:
        """Enclose the equations over the region |(x, u)_j| ≤ ``halfwidths``, (n + m,).

        Raises:
            NotEnclosedError: there is no enclosure, or the plant does not rest at x = 0, u = 0.
        """
        n, size = self.n, self.n + self.m
        rates = self._values(halfwidths, range(size))
        bent = [j for j in range(size) if any(_is_wide(rate.slopes[j]) for rate in rates)]

        @cache
        def column(j: int, moved: frozenset[int]) -> "list[arb]":
            if j not in bent:
                return [rate.slopes[j] for rate in rates]
            return self._mean_slope(halfwidths, j, moved)

        best, centre, halves = np.full(n, np.inf), np.zeros((n, size)), np.zeros((n, size))
        for order in _orders(size, bent):
            columns = [(j, frozenset(order[: order.index(j)])) for j in range(size)]
            middle, half = _box([column(*column_key) for column_key in columns])
            missed = half @ halfwidths
            rows = (missed < best)[:, None]
            centre, halves = np.where(rows, middle, centre), np.where(rows, half, halves)
            best = np.minimum(best, missed)
        if (self.at_rest > _AT_REST * np.abs(centre).max(axis=1)).any():
            raise NotEnclosedError(
                f"it does not rest at x = 0, u = 0: an entry of ẋ is {self.at_rest.max():.3g} there"
            )
        return Inclusion(centre[:, :n], centre[:, n:], halves[:, :n], halves[:, n:])

    def linear_within(self, largest: float) -> tuple[Matrix, Matrix] | None:
        """Return A and B if all derivatives are the same for |x_j|, |u_i| ≤ ``largest``, to rounding.

        None: they are not, or the plant does not rest at x = 0, u = 0.

        Raises:
            NotEnclosedError: there is no enclosure.
        """
        size = self.n + self.m
        rates = self._values(np.full(size, largest), range(size))
        centre, half = _box([[rate.slopes[j] for rate in rates] for j in range(size)])
        row_sizes = np.abs(centre).max(axis=1, keepdims=True)
        if (half > _NARROW * row_sizes).any() or self.at_rest.any():
            return None
        return centre[:, : self.n], centre[:, self.n :]

    @cached_property
    def at_rest(self) -> Vector:
        """Bounds of the entries of |f(0, 0)|, (n,): 0, or what rounding leaves.

        Raises:
            NotEnclosedError: there is no enclosure.
        """
        return np.array([_size(rate.value) for rate in self._values(np.zeros(self.n + self.m), range(0))])

    def _mean_slope(self, halfwidths: Vector, j: int, moved: frozenset[int]) -> "list[arb]":
        """Enclose ∫₀¹ ∂f/∂z_j ds at s z_j, with the coordinates ``moved`` and the others 0."""
        box = np.array([h if i in moved else 0.0 for i, h in enumerate(halfwidths.tolist())])
        total = [_ball(0.0)] * self.n
        for number in range(1, _SLICES + 1):
            box[j] = halfwidths[j] * (number / _SLICES) * (1 + 1e-15)
            rates = self._values(box, [j])
            total = [sum_ + rate.slopes[0] for sum_, rate in zip(total, rates, strict=True)]
        return [entry / _SLICES for entry in total]

    def _values(self, halfwidths: Vector, coordinates: Sequence[int]) -> list[Enclosed]:
        """Return f over a region, with its derivatives by some coordinates; that after (x, u) is time."""
        constant = [_ball(0.0)] * len(coordinates)
        enclosed = [
            Enclosed(_ball(0.0, width), [_ball(float(index == j)) for j in coordinates])
            for index, width in enumerate(halfwidths.tolist())
        ]
        x, u = np.split(np.array(enclosed, dtype=object), [self.n])
        of_time = [_ball(float(j == len(enclosed))) for j in coordinates]
        time = Enclosed(_ball(_LONGEST_S / 2, _LONGEST_S / 2), of_time)
        try:
            expressions = self.system.expressions(time, x, u)  # type: ignore[attr-defined]
        except TypeError as error:  # of an extension that uses math.sin
            raise NotEnclosedError(f"its equations are for floats alone: {one_line(error)}") from None
        if expressions is None:
            raise NotEnclosedError("x is neither its state nor its state minus a constant")
        rates, states = (
            [term if isinstance(term, Enclosed) else Enclosed(_ball(float(term)), constant) for term in part]
            for part in expressions
        )
        for state, coordinate in zip(states, enclosed[: self.n], strict=True):
            if not all((a - b).is_zero() for a, b in zip(state.slopes, coordinate.slopes, strict=True)):
                raise NotEnclosedError("x is not its state minus a constant")
        if not all(ball.is_finite() for rate in rates for ball in (rate.value, *rate.slopes)):
            raise NotEnclosedError("its equations are not defined and smooth in all of the region")
        return rates


def _orders(size: int, bent: Sequence[int]) -> Iterator[list[int]]:
    """Yield the orders of the coordinates that are tried: each first, and each last."""
    for k in bent or [0]:
        other_coordinates = [j for j in range(size) if j != k]
        yield [k, *other_coordinates]
        yield [*other_coordinates, k]


def _box(columns: "Sequence[Sequence[arb]]") -> tuple[Matrix, Matrix]:
    """Return centre and half-widths of a matrix of intervals, given by columns."""
    centre = np.array([[float(entry.mid()) for entry in column] for column in columns]).T
    halves = [
        [_size(entry - middle) for entry, middle in zip(*pair, strict=True)]
        for pair in zip(columns, centre.T.tolist(), strict=True)
    ]
    return centre, np.array(halves).T


def _is_wide(ball: "arb") -> bool:
    return bool(ball.rad() > _NARROW * ball.abs_upper())


def _size(ball: "arb") -> float:
    """Return a float that is at least |x| for every x of the ball."""
    return 0.0 if ball.is_zero() else math.nextafter(float(ball.abs_upper()), math.inf)
