"""A plant's equations on a region: a linear plant with unknown entries, and bounded disturbances.

The equations ẋ = f(x, u) are steps, of which each is a number, an entry of x or u, or a function of
earlier steps. With z = (x, u) in the region |z_k| ≤ r_k each step g is enclosed as

    g(z) = g(0) + Σ J_k z_k + c,

with g(0), J_k and c in balls. For a product, ab − a₀b₀ = b (a − a₀) + a₀ (b − b₀), or with a and b
exchanged: that with the narrower result is used. For a function with a derivative almost everywhere,
φ(g) − φ(g₀) = (g − g₀) ∫₀¹ φ'(g₀ + s (g − g₀)) ds, and the integral is in the mean of enclosures of φ' for
slices of s.

Each step has to be finite and defined on the whole region: then the equations are, whatever a later step
multiplies it by. A root needs a number that is not negative: by its enclosure, or because it is made of
squares, sizes, exponentials and numbers that are not. If it is a sum of squares, g = ‖h‖² with h in the
region's balls, then its root is ‖h‖, with the slopes ∫₀¹ v_k/‖v‖ ds ∈ [−1, 1], v = h₀ + s (h − h₀).

A sign, tanh, arctan or saturation of y = Cz grows with y, and is bounded. With the least and the largest
slope l and h of its chords from 0 it is l y + v p, with an unknown signal p, |p| ≤ 1, which is one more
entry of z, and v p y ≥ (v p)²/(h − l). So friction is known to be at most its size, and to take energy
out of the plant; sign has no largest slope.

So f(z) = (A + Δ)z + Σ column p + c, with entries of Δ in boxes.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from flint import arb, arb_mat, ctx

ctx.prec = 128  # bits of midpoints
MOST_STEPS = 5000
SIGNALS = ("sign", "tanh", "arctan", "clip")
"""Steps that may be unknown signals."""
_SLICES = 32
_LONGEST_S = 1e9
"""The time in equations is from 0 to this."""
_NARROW = 1e-25
"""An entry that varies by less, relatively, stays a ball, which rounding left; others have half-widths."""
_MOST_POWER = 100
_MOST_SQUARES = 100
_LARGEST = 1e300
"""A step that may be larger overflows in floating point."""
_UNDEFINED = {
    "log": "log of a number that may be 0 or negative",
    "power": "division by, or power of, a number that may be 0 or negative",
    "root": "root of a number that may be negative",
    "tan": "tan of an angle that may be π/2",
}


class RejectedError(ValueError):
    """Equations have no meaning or no enclosure, or a document does not allow what they do."""


class Along(NamedTuple):
    """A signal p has p·C(x, u) ≥ k p², as friction that takes energy out of the plant."""

    row: arb_mat  # C, (1, n + m); 0: nothing is known
    least: arb  # k ≥ 0


class Region(NamedTuple):
    """|x_i| < x[i] and |u_j| < u[j]: where a plant's equations are enclosed; None: any value."""

    x: tuple[arb | None, ...]
    u: tuple[arb | None, ...]


class UndecidedError(RejectedError):
    """Equations distinguish cases, of which the region has more than one."""


class UndefinedError(RejectedError):
    """A step is not proven to be finite and defined on the whole region."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"its equations are not finite on the whole region: {reason}")


class Enclosed(NamedTuple):
    """g(z) = ``centre`` + Σ ``slopes`` z + ``rest`` over the region, and its ``value`` there."""

    centre: arb
    slopes: tuple[arb, ...]
    rest: arb
    value: arb
    is_nonnegative: bool = False
    """g ≥ 0 by its form: a ball around [0, g] begins below 0."""
    squares: tuple["Enclosed", ...] = ()
    """g is the sum of the squares of these; empty: it is not known as such a sum."""

    @property
    def is_constant(self) -> bool:
        """Whether g does not depend on z."""
        return all(slope == 0 for slope in self.slopes) and bool(self.rest == 0)


class LinearPlants(NamedTuple):
    """ẋ = (A + Δ_A)x + (B + Δ_B)u + Σ column p, with |Δ| ≤ half and |p| ≤ 1."""

    A: arb_mat  # (n, n)
    B: arb_mat  # (n, m)
    half_A: arb_mat
    half_B: arb_mat
    pushes: arb_mat  # columns, (n, k)
    along: tuple[Along, ...]
    """What is known of the signal of each column."""


class Evaluation:
    """Encloses steps over a region, one after the other.

    Args:
        region: the region.
        signals: the most signals; enough are as many as there are steps in :data:`SIGNALS`.
    """

    def __init__(self, region: Region, signals: int) -> None:
        self.n, self.m, self._signals = len(region.x), len(region.u), signals
        everywhere = arb(0, float("inf"))
        limits = [everywhere if r is None else around_zero(r) for r in (*region.x, *region.u)]
        self._z = [*limits, *[around_zero(arb(1))] * signals]
        self.along: list[Along] = []

    def step(self, name: str, operands: Sequence[Enclosed], numbers: Sequence[float | None]) -> Enclosed:
        """Return a step: a function of other steps, and of numbers.

        Raises:
            RejectedError: there is no such function, or it does not have such operands.
            UndecidedError: what a case requires is not proven.
            UndefinedError: it is not proven to be finite on the whole region.
        """
        shape = len(operands), len(numbers)
        if name in FUNCTIONS and shape == (1, 0):
            term = self._function(operands[0], *FUNCTIONS[name])
        elif name in SHAPES and SHAPES[name] == shape:
            term = getattr(self, f"_{name}")(*operands, *numbers)
        else:
            raise RejectedError(f"equations: {name[:50]!r} is no step of such a shape")
        if term.value.is_nan():
            raise UndefinedError(_UNDEFINED.get(name, name))
        if not all(ball.abs_upper() < _LARGEST for ball in (term.centre, *term.slopes, term.rest)):
            raise UndefinedError(f"{name} may be too large")
        return term._replace(
            is_nonnegative=_is_nonnegative(name, operands, numbers),
            squares=self._squares(name, operands, numbers)[:_MOST_SQUARES],
        )

    def _squares(
        self, name: str, operands: Sequence[Enclosed], numbers: Sequence[float | None]
    ) -> tuple[Enclosed, ...]:
        """Return terms whose squares add up to a step; none: no such terms are known."""
        if name == "power" and numbers[0] == 2:
            return (operands[0],)
        if name == "number" and (value := _finite(numbers[0])) >= 0:
            return (self._constant(value.sqrt()),)
        if name == "add" and all(operand.squares for operand in operands):
            return operands[0].squares + operands[1].squares
        if name == "times":
            for factor, other in (operands, operands[::-1]):
                if factor.is_constant and factor.centre >= 0:
                    root = self._constant(factor.centre.sqrt())
                    return tuple(self._times(root, term) for term in other.squares)
        return ()

    def _state(self, index: float) -> Enclosed:
        return self._coordinate(index, 0, self.n)

    def _input(self, index: float) -> Enclosed:
        return self._coordinate(index, self.n, self.m)

    def _coordinate(self, index: float, first: int, count: int) -> Enclosed:
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < count:
            raise RejectedError("equations: no such state or input")
        return self._unit(first + index)

    def _unit(self, index: int) -> Enclosed:
        slopes = tuple(arb(int(k == index)) for k in range(len(self._z)))
        return Enclosed(arb(0), slopes, arb(0), self._z[index])

    def _number(self, value: float | None) -> Enclosed:
        return self._constant(_finite(value))

    def _time(self) -> Enclosed:
        return self._constant(arb(_LONGEST_S / 2, _LONGEST_S / 2))

    def _constant(self, value: arb) -> Enclosed:
        return Enclosed(value, (arb(0),) * len(self._z), arb(0), value)

    def _add(self, a: Enclosed, b: Enclosed) -> Enclosed:
        slopes = [p + q for p, q in zip(a.slopes, b.slopes, strict=True)]
        return self._term(a.centre + b.centre, slopes, a.rest + b.rest, a.value + b.value)

    def _negative(self, a: Enclosed) -> Enclosed:
        return Enclosed(-a.centre, tuple(-slope for slope in a.slopes), -a.rest, -a.value)

    def _times(self, a: Enclosed, b: Enclosed) -> Enclosed:
        """Return the product, in the form whose slopes and rest are the narrower ones."""
        return self._narrowest([self._product(a, b), self._product(b, a)])

    def _narrowest(self, forms: Sequence[Enclosed]) -> Enclosed:
        return min(forms, key=lambda form: float(self._width(form).upper()))

    def _product(self, a: Enclosed, b: Enclosed) -> Enclosed:
        pairs = zip(a.slopes, b.slopes, strict=True)
        slopes = [_times(b.value, p) + _times(a.centre, q) for p, q in pairs]
        rest = _times(b.value, a.rest) + _times(a.centre, b.rest)
        return self._term(a.centre * b.centre, slopes, rest, _times(a.value, b.value))

    def _width(self, term: Enclosed) -> arb:
        radii = (_times(arb(slope.rad()), z) for slope, z in zip(term.slopes, self._z, strict=True))
        width = sum((arb(radius.abs_upper()) for radius in radii), arb(term.rest.rad()))
        return width if width.is_finite() else arb(1e300)

    def _power(self, a: Enclosed, exponent: float | None) -> Enclosed:
        power = float(_finite(exponent))
        if abs(power) > _MOST_POWER:
            raise RejectedError("equations: an exponent is too large")
        if power == 0:
            return self._constant(arb(1))
        if power == 2:  # the slope of the chord is g + g₀
            return self._by_chord(a, lambda g: _power(g, 2), a.value + a.centre)
        return self._function(a, lambda g: _power(g, power), lambda g: power * _power(g, power - 1))

    def _root(self, a: Enclosed) -> Enclosed:
        """Return √g: the slope of its chord is 1/(√g + √g₀), or √g is the norm of the squares in g."""

        def root(g: arb) -> arb:
            return _at_ends(g, lambda end: end.max(arb(0)).sqrt())

        if not (a.is_nonnegative or a.value >= 0):
            raise UndefinedError(_UNDEFINED["root"])
        if a.is_constant:
            return self._constant(root(a.centre))
        forms = []
        if a.squares:
            forms.append(self._norm(a.squares, root(a.value)))
        if a.centre > 0:
            forms.append(self._by_chord(a, root, 1 / (root(a.value) + a.centre.sqrt())))
        if not forms:
            raise UndefinedError("root of a number that may be 0 at x = 0: its slope is infinite there")
        return self._narrowest(forms)

    def _norm(self, squares: Sequence[Enclosed], value: arb) -> Enclosed:
        """Return the root of a sum of squares, which has this value over the region."""
        changes = [_both(h.value - h.centre, self._change(h)) for h in squares]
        slopes = [arb(0)] * len(squares)
        for part in _slices():
            v = [h.centre + _times(part, change) for h, change in zip(squares, changes, strict=True)]
            size = arb(sum((_power(entry, 2) for entry in v), arb(0)).lower()).max(arb(0)).sqrt()
            for k, entry in enumerate(v):
                slopes[k] += _between_ones(entry / size if size > 0 else arb.nan()) / _SLICES
        pairs = list(zip(slopes, squares, strict=True))
        centre = sum((_power(h.centre, 2) for h in squares), arb(0)).sqrt()
        combined = [
            sum((_times(slope, h.slopes[k]) for slope, h in pairs), arb(0)) for k in range(len(self._z))
        ]
        rest = sum((_times(slope, h.rest) for slope, h in pairs), arb(0))
        return self._term(centre, combined, rest, value)

    def _by_chord(self, a: Enclosed, value: Callable[[arb], arb], chord: arb) -> Enclosed:
        """Return a function with these slopes of chords from g₀."""
        slopes = [_times(chord, slope) for slope in a.slopes]
        return self._term(value(a.centre), slopes, _times(chord, a.rest), value(a.value))

    def _clip(self, a: Enclosed, low: float | None, high: float | None) -> Enclosed:
        """Return min(max(g, low), high); None: without this limit."""
        least, most = (
            arb(sign * float("inf")) if end is None else _finite(end) for sign, end in ((-1, low), (1, high))
        )

        def value(g: arb) -> arb:
            return _at_ends(g, lambda end: end.max(least).min(most))

        def slope(g: arb) -> arb:
            if g >= least and g <= most:
                return arb(1)
            return arb(0) if g <= least or g >= most else arb(0.5, 0.5)

        if low is None or high is None:
            return self._function(a, value, slope)
        return self._bounded(a, value, slope)

    def _tanh(self, a: Enclosed) -> Enclosed:
        return self._bounded(
            a,
            lambda g: _at_ends(g, lambda end: end.tanh()),
            lambda g: _at_sizes(g, lambda end: end.sech() ** 2),
        )

    def _arctan(self, a: Enclosed) -> Enclosed:
        return self._bounded(
            a, lambda g: _at_ends(g, lambda end: end.atan()), lambda g: 1 / (1 + _power(g, 2))
        )

    def _sign(self, a: Enclosed) -> Enclosed:
        if a.value > 0 or a.value < 0:
            return self._constant(arb(1 if a.value > 0 else -1))
        row = self._linear_row(a) if a.centre == 0 else None
        return self._signal(arb(1), row, arb(0))

    def _bounded(
        self, a: Enclosed, value: Callable[[arb], arb], derivative: Callable[[arb], arb]
    ) -> Enclosed:
        """Return an increasing function: l y + v p, if y = g − g₀ is linear, else by slopes."""
        by_slopes, row = self._function(a, value, derivative), self._linear_row(a)
        largest = (value(a.value) - value(a.centre)).abs_upper()
        mean = self._mean_slope(a, derivative)
        least = mean.lower().max(arb(0))
        gap = mean.upper() - least
        is_wide = gap > _NARROW and gap.is_finite() and largest > 0
        if row is None or not is_wide or self._has_all_signals:
            return by_slopes
        p = self._signal(arb(largest), gap / largest * row, arb(1))
        slopes = [least * slope + q for slope, q in zip(a.slopes, p.slopes, strict=True)]
        return self._term(by_slopes.centre, slopes, arb(0), by_slopes.value)

    @property
    def _has_all_signals(self) -> bool:
        return len(self.along) == self._signals

    def _linear_row(self, a: Enclosed) -> arb_mat | None:
        """Return C of g = g₀ + Cz for states and inputs; None if it is not linear."""
        states = self.n + self.m
        is_known = all(slope.rad() <= _NARROW for slope in a.slopes)
        if not (a.rest == 0 and is_known and all(slope == 0 for slope in a.slopes[states:])):
            return None  # a ball around 0 is not 0
        return arb_mat(1, states, a.slopes[:states])

    def _signal(self, size: arb, row: arb_mat | None, least: arb) -> Enclosed:
        """Return v p of the next signal p, with p·``row`` z ≥ ``least`` p²."""
        if self._has_all_signals:
            raise RejectedError("its equations jump: sign needs an unknown signal")
        index = self.n + self.m + len(self.along)
        self.along.append(Along(arb_mat(1, self.n + self.m) if row is None else row, least))
        slopes = tuple(size if k == index else arb(0) for k in range(len(self._z)))
        return Enclosed(arb(0), slopes, arb(0), around_zero(size))

    def _positive(self, a: Enclosed) -> Enclosed:
        """Require g > 0: then a case of the equations is the one that holds."""
        if not a.value > 0:
            raise UndecidedError("its equations distinguish cases, and the region contains more than one")
        return a

    def _nonnegative(self, a: Enclosed) -> Enclosed:
        if not a.value >= 0:
            raise UndecidedError("its equations distinguish cases, and the region contains more than one")
        return a

    def _function(
        self, a: Enclosed, value: Callable[[arb], arb], derivative: Callable[[arb], arb]
    ) -> Enclosed:
        if a.is_constant:
            return self._constant(value(a.centre))
        return self._by_chord(a, value, self._mean_slope(a, derivative))

    def _mean_slope(self, a: Enclosed, derivative: Callable[[arb], arb]) -> arb:
        """Enclose the slopes of chords from g₀ to g."""
        change = _both(a.value - a.centre, self._change(a))
        slopes = [derivative(a.centre + _times(part, change)) for part in _slices()]
        return sum(slopes, arb(0)) / _SLICES

    def _change(self, a: Enclosed) -> arb:
        moved = (_times(slope, z) for slope, z in zip(a.slopes, self._z, strict=True))
        return sum(moved, a.rest)

    def _term(self, centre: arb, slopes: Sequence[arb], rest: arb, value: arb) -> Enclosed:
        term = Enclosed(centre, tuple(slopes), rest, value)
        return term._replace(value=_both(value, centre + self._change(term)))

    def plants(self, rates: Sequence[Enclosed]) -> LinearPlants:
        """Return the plants that have these rates ẋ."""
        n, states = self.n, self.n + self.m
        centre, half = arb_mat(n, len(self._z)), arb_mat(n, len(self._z))
        rests = []
        for i, rate in enumerate(rates):
            largest = frobenius(arb_mat(1, len(rate.slopes), [slope.abs_upper() for slope in rate.slopes]))
            for k, slope in enumerate(rate.slopes):
                is_narrow = bool(slope.rad() <= _NARROW * largest)
                centre[i, k] = slope if is_narrow else slope.mid()
                half[i, k] = arb(0) if is_narrow else arb(slope.rad())
            unknown = [arb(half[i, k]) for k in range(states, len(self._z))]
            rests.append(arb((sum(unknown, abs(rate.centre + rate.rest))).abs_upper()))
        columns = [[centre[i, states + k] for i in range(n)] for k in range(self._signals)]
        unknown_signal = Along(arb_mat(1, states), arb(0))
        along = [*self.along, *[unknown_signal] * (self._signals - len(self.along))]
        for i, rest in enumerate(rests):
            if rest > 0:
                columns.append([rest if k == i else arb(0) for k in range(n)])
                along.append(unknown_signal)
        kept = [k for k, column in enumerate(columns) if not all(entry == 0 for entry in column)]

        def block(M: arb_mat, first: int, last: int) -> arb_mat:
            return arb_mat(n, last - first, [M[i, k] for i in range(n) for k in range(first, last)])

        return LinearPlants(
            block(centre, 0, n),
            block(centre, n, states),
            block(half, 0, n),
            block(half, n, states),
            arb_mat(n, len(kept), [columns[k][i] for i in range(n) for k in kept]),
            tuple(along[k] for k in kept),
        )


def _is_nonnegative(name: str, operands: Sequence[Enclosed], numbers: Sequence[float | None]) -> bool:
    """Return whether a step is at least 0 by its form, in floating point, too."""
    if name in ("add", "times"):
        return all(operand.is_nonnegative for operand in operands)
    if name == "number":
        return bool(_finite(numbers[0]) >= 0)
    if name == "power":
        return operands[0].is_nonnegative or float(numbers[0] or 0) % 2 == 0
    if name == "clip":
        low, high = numbers
        return (operands[0].is_nonnegative or (low is not None and low >= 0)) and (high is None or high >= 0)
    return name in _NONNEGATIVE


def _slices() -> list[arb]:
    """Return balls that cover [0, 1]."""
    return [arb((k + 0.5) / _SLICES, 0.5 / _SLICES) for k in range(_SLICES)]


def _between_ones(g: arb) -> arb:
    """Return the numbers of a ball that are in [−1, 1]."""
    ones = arb(0, 1)
    return g.intersection(ones) if g.is_finite() and g.overlaps(ones) else ones


def _times(a: arb, b: arb) -> arb:
    """Return a product, in which 0 times any number is 0."""
    return arb(0) if a.is_zero() or b.is_zero() else a * b


def _both(a: arb, b: arb) -> arb:
    """Return numbers that are in both balls; NaN, what is not defined, if the first one is."""
    if not (a.is_finite() and b.is_finite()):
        return a if a.is_finite() or a.is_nan() else b
    return a.intersection(b)


def _at_ends(g: arb, function: Callable[[arb], arb]) -> arb:
    """Enclose a monotonic function: between its values at the ends of the interval."""
    return function(g.lower()).union(function(g.upper()))


def _at_sizes(g: arb, function: Callable[[arb], arb]) -> arb:
    """Enclose a monotonic function of |g|."""
    return function(g.abs_lower()).union(function(g.abs_upper()))


def _power(g: arb, power: float) -> arb:
    """Enclose gᵖ: it is monotonic, or a monotonic function of |g|."""
    if power < 0:
        return 1 / _power(g, -power)
    if power % 1:
        return _at_ends(g, lambda end: end ** arb(power)) if g > 0 else arb.nan()
    at = _at_sizes if power % 2 == 0 else _at_ends
    return at(g, lambda end: end ** int(power))


def _tan(g: arb) -> arb:
    return _at_ends(g, lambda end: end.tan()) if g.cos() > 0 else arb.nan()


def _slope_of_size(g: arb) -> arb:
    return arb(1) if g >= 0 else arb(-1) if g <= 0 else around_zero(arb(1))


def _size(g: arb) -> arb:
    return _at_sizes(g, lambda end: end)


def _exp(g: arb) -> arb:
    return _at_ends(g, lambda end: end.exp())


FUNCTIONS: Mapping[str, tuple[Callable[[arb], arb], Callable[[arb], arb]]] = {
    "sin": (lambda g: g.sin(), lambda g: g.cos()),
    "cos": (lambda g: g.cos(), lambda g: -g.sin()),
    "tan": (_tan, lambda g: 1 / _power(g.cos(), 2)),
    "sinh": (lambda g: _at_ends(g, lambda end: end.sinh()), lambda g: _at_sizes(g, lambda end: end.cosh())),
    "cosh": (lambda g: _at_sizes(g, lambda end: end.cosh()), lambda g: _at_ends(g, lambda end: end.sinh())),
    "exp": (_exp, _exp),
    "log": (lambda g: _at_ends(g, lambda end: end.log()) if g > 0 else arb.nan(), lambda g: 1 / g),
    "abs": (_size, _slope_of_size),
}
"""Functions with their derivatives."""
_NONNEGATIVE = ("abs", "exp", "cosh", "root", "time")
SHAPES = {
    "state": (0, 1), "input": (0, 1), "number": (0, 1), "time": (0, 0), "add": (2, 0), "times": (2, 0),
    "negative": (1, 0), "power": (1, 1), "clip": (1, 2), "sign": (1, 0), "positive": (1, 0),
    "nonnegative": (1, 0), "tanh": (1, 0), "arctan": (1, 0), "root": (1, 0),
}  # fmt: skip
"""Other steps: how many operands and numbers they have."""


def enclose(equations: Mapping[str, object], region: Region) -> LinearPlants:
    """Return the plants that have the equations of a document within a region.

    Args:
        equations: "steps", each a list of a name, indices of earlier steps and numbers, and "rates",
            the indices of ẋ.
        region: the region.

    Raises:
        RejectedError: the equations have no meaning, or no enclosure.
    """
    steps, rates = equations.get("steps"), equations.get("rates")
    if not isinstance(steps, list) or not 0 < len(steps) <= MOST_STEPS:
        raise RejectedError(f"equations: not from 1 to {MOST_STEPS} steps")
    if not all(isinstance(step, list) and step and isinstance(step[0], str) for step in steps):
        raise RejectedError("equations: a step is no list with a name")
    evaluation = Evaluation(region, sum(step[0] in SIGNALS for step in steps))
    done: list[Enclosed] = []
    for name, *rest in steps:
        count = 1 if name in FUNCTIONS else SHAPES.get(name, (0, 0))[0]
        operands = [_earlier(done, index) for index in rest[:count]]
        done.append(evaluation.step(name, operands, rest[count:]))
    if not isinstance(rates, list) or len(rates) != len(region.x):
        raise RejectedError("equations: not one rate for each state")
    return evaluation.plants([_earlier(done, index) for index in rates])


def _earlier(done: Sequence[Enclosed], index: object) -> Enclosed:
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(done):
        raise RejectedError("equations: a step refers to none before it")
    return done[index]


def region_of(x: Sequence[object], u: Sequence[object]) -> Region:
    """Return a region from its sizes, of which None is no limit."""
    found = []
    for sizes in (x, u):
        limits = [None if limit is None else _finite(limit) for limit in sizes]
        if not all(limit is None or limit > 0 for limit in limits):
            raise RejectedError("region: a size is not above 0")
        found.append(tuple(limits))
    return Region(*found)


def _finite(value: object) -> arb:
    """Return a finite number; a float is the exact binary value that it has."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise RejectedError("equations: not a number")
    if (isinstance(value, int) and abs(value) > 2**63) or not math.isfinite(value):
        raise RejectedError("equations: not finite, or too large")
    return arb(value)


def around_zero(radius: arb) -> arb:
    """Return the ball of all numbers of at most this size."""
    return arb(0, radius.abs_upper())


def frobenius(M: arb_mat) -> arb:
    """Return the root of the sum of squares of the entries."""
    return arb(sum((entry * entry for entry in M.entries()), arb(0)).upper()).sqrt()
