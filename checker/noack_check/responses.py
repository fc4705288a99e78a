"""Responses C e^{Mt} Y of a linear system, enclosed: the largest norm, and the integral of the norm."""

from collections.abc import Sequence
from typing import NamedTuple

from flint import arb, arb_mat

from noack_check.balls import beside, columns_of, frobenius, identity, is_positive, is_zero, transpose, upto
from noack_check.check import RejectedError
from noack_check.norms import spectral_norm

_SQUARINGS = 8
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


def responses(
    M: arb_mat, decay: Decay, outputs: Sequence[arb_mat], inputs: Sequence[arb_mat]
) -> list[list[Response]]:
    """Return the responses of each output to each input over all t ≥ 0.

    On a step s each z = e^{Mt} Y is within s²/8 · sup ‖M²z‖ of its chord, and with |z|² = trace zᵀPz both |z|
    and |M²z| fall. A norm of a chord is at most the chord of the norms. |Cz| ≤ c |z| with
    c² = ‖C P⁻¹ Cᵀ‖. So after any time the rest is known, too: ∫ |z| dt ≤ |z| / ν.
    """
    P, Z = decay.form, inputs[0]
    for Y in inputs[1:]:
        Z = beside(Z, Y)
    start, time = Z, arb(0)
    inverse, parts, first = decay.inverse, [], 0
    for Y in inputs:
        parts.append(range(first, first + Y.ncols()))
        first += Y.ncols()
    reach = [norm_of(C * inverse * transpose(C)).sqrt() for C in outputs]
    starts = sizes = _sizes(P, Z, parts)
    ends = _norms(outputs, Z, parts)
    most, totals = [list(row) for row in ends], [[arb(0)] * len(inputs) for _ in outputs]
    squared, step, steps = M * M, arb(2) ** -60, dict[str, arb_mat]()
    while bool(step * 64 * spectral_norm(M) < 1) and step < 2**20:
        step *= 2
    for count in range(1, _MOST_CELLS):
        bends = [b * step**2 / 8 for b in _sizes(P, squared * Z, parts)]
        limits = [_BEND * (a + _SMALL * b) for a, b in zip(sizes, starts, strict=True)]
        if not all(b <= a for a, b in zip(limits, bends, strict=True)):
            step /= 2
            continue
        key, time = str(step.mid()), time + step
        if key not in steps:
            steps[key] = (step * M).exp()
        Z = steps[key] * Z if count % _KEPT else (time * M).exp() * start
        begins, ends = ends, _norms(outputs, Z, parts)
        for i, c in enumerate(reach):
            for j, bend in enumerate(bends):
                a, b = begins[i][j], ends[i][j]
                most[i][j] = most[i][j].max(b + c * bend).max(a + c * bend)
                totals[i][j] += step * ((a + b) / 2 + 2 * c * bend / 3)
        sizes = _sizes(P, Z, parts)
        rest = [[c * size / decay.rate for size in sizes] for c in reach]
        pairs = [pair for rows in zip(rest, totals, strict=True) for pair in zip(*rows, strict=True)]
        is_little = all(a <= _REST**3 * b for a, b in zip(sizes, starts, strict=True))
        if is_little or all(left <= _REST * total for left, total in pairs):
            break
        if all(4 * b <= a for a, b in zip(limits, bends, strict=True)):
            step *= 2
    else:
        raise RejectedError("a response takes too many steps to enclose")
    return [
        [
            Response(upper(most[i][j].max(c * size)), upper(totals[i][j] + c * size / decay.rate))
            for j, size in enumerate(sizes)
        ]
        for i, c in enumerate(reach)
    ]


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


def norm_of(M: arb_mat) -> arb:
    """Return an upper bound of ‖M‖₂."""
    if is_zero(M):
        return arb(0)
    return frobenius(M) if min(M.nrows(), M.ncols()) == 1 else spectral_norm(M, _SQUARINGS)


def upper(value: arb) -> arb:
    """Return an exact number that is at least a value which is not negative."""
    return arb(value.abs_upper())


def _norms(outputs: Sequence[arb_mat], Z: arb_mat, parts: Sequence[range]) -> list[list[arb]]:
    found = []
    for CZ in (C * Z for C in outputs):
        if CZ.nrows() == 1:  # most are: their norms of single columns are sizes of entries
            columns = [abs(entry) for entry in CZ.entries()]
        else:
            squares = transpose(CZ) * CZ
            columns = [upper(squares[k, k]).sqrt() for k in range(CZ.ncols())]
        found.append([columns[p.start] if len(p) == 1 else norm_of(columns_of(CZ, p)) for p in parts])
    return found


def _sizes(P: arb_mat, Z: arb_mat, parts: Sequence[range]) -> list[arb]:
    """Return upper bounds of √(trace zᵀPz) of some columns each."""
    squares = transpose(Z) * (P * Z)
    return [upper(upper(sum((squares[k, k] for k in part), arb(0))).sqrt()) for part in parts]
