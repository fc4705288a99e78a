"""Responses C e^{Mt} Y of a linear system, enclosed: the largest norm, and the integral of the norm."""

from bisect import bisect_right
from collections.abc import Sequence
from functools import lru_cache
from operator import mul
from typing import NamedTuple

from flint import arb, arb_mat

from noack_gains.balls import (
    beside,
    columns_of,
    identity,
    is_positive,
    norm_of,
    spectral_norm,
    transpose,
    upper,
    upto,
)
from noack_gains.reading import RejectedError

_CELLS, _MOST_CELLS = 48, 6000
_KEPT = 32
"""A state is computed from the start after so many steps: balls grow."""
_BEND, _SMALL = 1e-3, 1e-4
"""How far a chord may be from its curve, as a share of |z|, or of it at the start."""
_REST = 1e-3
"""The share of an integral that is left to the tail."""


class Response(NamedTuple):
    """Upper bounds of sup ‖C e^{Mt} Y‖ and of ∫ ‖C e^{Mt} Y‖ dt."""

    most: arb
    total: arb


class Decay(NamedTuple):
    """P ≻ 0 and ν > 0 with MᵀP + PM ⪯ −2νP: so √(zᵀPz) falls like e^{−νt}."""

    form: arb_mat
    rate: arb

    @property
    def inverse(self) -> arb_mat:
        """P⁻¹."""
        try:
            return self.form.inv()
        except ZeroDivisionError:
            raise RejectedError("a form is not proven to have an inverse") from None

    def require(self, M: arb_mat, name: str) -> None:
        """Raise RejectedError if this is not proven of a matrix."""
        if not self.rate > 0:
            raise RejectedError(f"{name}: its rate of decay is not above 0")
        P = self.form
        falls = -1 * (transpose(M) * P + P * M + 2 * self.rate * P)
        has_inverse = all(P[i, i] > 0 for i in range(P.nrows()))  # beside is_positive
        if not (has_inverse and is_positive(P) and is_positive(falls)):
            raise RejectedError(f"{name}: not proven to decay so fast")


class _Cell(NamedTuple):
    """A step: the norms at both of its ends, by output and input, and what is known of each input."""

    begin: arb
    step: arb
    begins: list[list[arb]]
    ends: list[list[arb]]
    sizes: list[arb]  # of |z| at the begin
    bends: list[arb]  # how far each z is from its chord
    totals: list[list[arb]]  # the integrals of the chords up to the end
    bent: list[arb]  # those of how far each z is from them


class Question:
    """A matrix M, its decay, outputs C and inputs Y; questions are equal if all their numbers are."""

    def __init__(
        self, M: arb_mat, decay: Decay, outputs: Sequence[arb_mat], inputs: Sequence[arb_mat]
    ) -> None:
        self.M, self.decay, self.outputs, self.inputs = M, decay, outputs, inputs
        matrices = [M, decay.form, *outputs, *inputs]
        try:
            of_matrices = [(each.ncols(), *map(_exact, each.entries())) for each in matrices]
            self._numbers: object = (len(outputs), _exact(decay.rate), *of_matrices)
        except ValueError:  # some are not finite
            self._numbers = object()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Question) and self._numbers == other._numbers

    def __hash__(self) -> int:
        return hash(self._numbers)


def _exact(value: arb) -> object:
    return value.mid().man_exp(), value.rad().man_exp()


class EnclosedResponses:
    """The responses C e^{Mt} Y of each output C to each input Y over all t ≥ 0.

    On a step s each z = e^{Mt} Y is within s²/8 · sup ‖M²z‖ of its chord, and with |z|² = trace zᵀPz both |z|
    and |M²z| fall. A norm of a chord is at most the chord of the norms. |Cz| ≤ c |z| with
    c² = ‖C P⁻¹ Cᵀ‖. So after any time the rest is known, too: ∫ |z| dt ≤ |z| / ν.

    Args:
        of: M, its decay, every C and every Y.
        rest: the share of an integral that is left to the tail.

    Raises:
        RejectedError: it takes too many steps to enclose them.
    """

    def __init__(self, of: Question, rest: float = _REST) -> None:
        M, decay, outputs, inputs = of.M, of.decay, of.outputs, of.inputs
        self._rate, self._cells = decay.rate, list[_Cell]()
        P, inverse, start, parts = decay.form, decay.inverse, inputs[0], [range(inputs[0].ncols())]
        for Y in inputs[1:]:
            parts.append(range(start.ncols(), start.ncols() + Y.ncols()))
            start = beside(start, Y)
        self._reach = [norm_of(C * inverse * transpose(C)).sqrt() for C in outputs]
        Z, time, squared, steps = start, arb(0), M * M, dict[str, arb_mat]()
        starts = sizes = _sizes(P, Z, parts)
        ends, totals = _norms(outputs, Z, parts), [[arb(0)] * len(inputs) for _ in outputs]
        bent, step, fastest = [arb(0)] * len(inputs), arb(2) ** -60, 64 * spectral_norm(M)
        while bool(step * fastest < 1) and step < 2**20:
            step *= 2
        for count in range(1, _MOST_CELLS):
            curved, half = step**2 / 8, step / 2
            bends = [curved * b for b in _sizes(P, squared * Z, parts)]
            limits = [_BEND * (a + _SMALL * b) for a, b in zip(sizes, starts, strict=True)]
            if not all(b <= a for a, b in zip(limits, bends, strict=True)):
                step = half
                continue
            key, begin, begins, before = str(step.mid()), time, ends, sizes
            time += step
            if not time.is_exact():
                raise RejectedError("the steps of a response are of too different sizes")
            if key not in steps:
                steps[key] = (step * M).exp()
            Z = steps[key] * Z if count % _KEPT else (time * M).exp() * start
            ends, sizes = _norms(outputs, Z, parts), _sizes(P, Z, parts)
            totals = [
                [total + half * (a + b) for total, a, b in zip(*rows, strict=True)]
                for rows in zip(totals, begins, ends, strict=True)
            ]
            bent = [area + 2 * step * bend / 3 for area, bend in zip(bent, bends, strict=True)]
            self._cells.append(_Cell(begin, step, begins, ends, before, bends, totals, bent))
            is_little = all(a <= _REST**3 * b for a, b in zip(sizes, starts, strict=True))
            shares = zip(self._reach, totals, strict=True)
            left = [size / (rest * self._rate) for size in sizes]
            if is_little or all(
                c * a <= total for c, row in shares for a, total in zip(left, row, strict=True)
            ):
                break
            if all(4 * b <= a for a, b in zip(limits, bends, strict=True)):
                step *= 2
        else:
            raise RejectedError("a response takes too many steps to enclose")
        self._end, self._sizes = time, sizes
        self._begins = [cell.begin for cell in self._cells]
        self._known = dict[tuple[int, int], list[arb]]()

    def after(self, time: arb) -> list[list[Response]]:
        """Return the responses of each output to each input from a time t ≥ 0 on."""
        time = arb(time.abs_lower())
        place = bisect_right(self._begins, time) - 1 if time < self._end else None
        return [
            [self._after(time, place, i, j) for j in range(len(self._sizes))] for i in range(len(self._reach))
        ]

    def _after(self, time: arb, place: int | None, i: int, j: int) -> Response:
        c, size, last = self._reach[i], self._sizes[j], self._cells[-1]
        if place is None:
            size *= (self._rate * (self._end - time)).exp()
            return Response(upper(c * size), upper(c * size / self._rate))
        cell, following = self._cells[place], self._tops(i, j)[place + 1]
        a, b, bend = cell.begins[i][j], cell.ends[i][j], c * cell.bends[j]
        a += (time - cell.begin) / cell.step * (b - a)
        total = (cell.begin + cell.step - time) * ((a + b) / 2 + bend) + c * size / self._rate
        total += last.totals[i][j] - cell.totals[i][j] + c * (last.bent[j] - cell.bent[j])
        return Response(upper(following.max(a.max(b) + bend)), upper(total))

    def _tops(self, i: int, j: int) -> list[arb]:
        """Return the suprema from the begin of each cell on, and from the end on."""
        if (i, j) not in self._known:
            c = self._reach[i]
            most = c * self._sizes[j]
            found = [most]
            for cell in reversed(self._cells):
                a, b = cell.begins[i][j], cell.ends[i][j]
                top = (a if b <= a else a.max(b)) + c * cell.bends[j]
                most = top if most <= top else most.max(top)
                found.append(most)
            self._known[i, j] = found[::-1]
        return self._known[i, j]


@lru_cache(maxsize=4)  # of some MB each
def enclose(of: Question, rest: float) -> EnclosedResponses:
    """Return enclosed responses; those of equal numbers share them."""
    return EnclosedResponses(of, rest)


def responses(
    M: arb_mat, decay: Decay, outputs: Sequence[arb_mat], inputs: Sequence[arb_mat]
) -> list[list[Response]]:
    """Return the responses of each output to each input over all t ≥ 0."""
    return _over_all_times(Question(M, decay, outputs, inputs))


@lru_cache(maxsize=64)
def _over_all_times(of: Question) -> list[list[Response]]:
    return EnclosedResponses(of).after(arb(0))


def responses_until(
    M: arb_mat, until: arb, outputs: Sequence[arb_mat], inputs: Sequence[arb_mat]
) -> list[list[Response]]:
    """Return the responses of each output to each input over 0 ≤ t ≤ ``until``."""
    cells = _CELLS if until > 0 else 1
    step, edge = until / cells, identity(M.nrows())
    within, forward = (upto(step) * M).exp(), (step * M).exp()
    most = [[arb(0)] * len(inputs) for _ in outputs]
    totals = [[arb(0)] * len(inputs) for _ in outputs]
    for _ in range(cells):
        during = edge * within
        for i, C in enumerate(outputs):
            left = C * during
            for j, Y in enumerate(inputs):
                norm = norm_of(left * Y)
                most[i][j], totals[i][j] = most[i][j].max(norm), totals[i][j] + step * norm
        edge = edge * forward
    return [
        [Response(upper(a), upper(b)) for a, b in zip(*rows, strict=True)]
        for rows in zip(most, totals, strict=True)
    ]


def _norms(outputs: Sequence[arb_mat], Z: arb_mat, parts: Sequence[range]) -> list[list[arb]]:
    """Return upper bounds of ‖CZ‖ for each output and some columns of Z each."""
    found, width = [], Z.ncols()
    for CZ in (C * Z for C in outputs):
        entries, is_row = CZ.entries(), CZ.nrows() == 1
        found.append(
            [
                norm_of(columns_of(CZ, part))
                if len(part) != 1
                else abs(entries[part.start])
                if is_row
                else _length(entries[part.start :: width])
                for part in parts
            ]
        )
    return found


def _length(entries: Sequence[arb]) -> arb:
    return upper(sum(map(mul, entries, entries), arb(0))).sqrt()


def _sizes(P: arb_mat, Z: arb_mat, parts: Sequence[range]) -> list[arb]:
    """Return upper bounds of √(trace zᵀPz) of some columns each."""
    squares = transpose(Z) * (P * Z)
    return [upper(sum((squares[k, k] for k in part), arb(0))).sqrt() for part in parts]
