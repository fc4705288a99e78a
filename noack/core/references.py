"""The reference that a loop follows: x_r(t), a solution of the model, and its input u_r(t).

A reference is a sequence of segments. In each, x_r and u_r are polynomials of the time since its
begin, plus sine waves. A set-point is one segment with constants. The core evaluates references
(native/loop/reference.c), so they have the same bits everywhere.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import CData
from noack.core.core_library import core, new_handle, new_structure, pointer_to
from noack.core.linear_systems import Matrix, Propagator, Vector


@dataclass(frozen=True)
class ReferenceSegment:
    """A part of a reference: Σ_k polynomial_k τ^k + Σ_l sines_l sin 2πf_l τ + cosines_l cos 2πf_l τ.

    Rows have the n states of x_r, and then the m inputs of u_r.
    """

    begin_ns: int
    """Where it begins, and τ with it; the first one of a reference begins at 0."""
    polynomial: Matrix  # (powers, n + m)
    hz: Vector  # f, (waves,)
    sines: Matrix  # (waves, n + m)
    cosines: Matrix  # (waves, n + m)

    @property
    def is_zero(self) -> bool:
        """Whether x_r and u_r are 0 in it."""
        return not (self.polynomial.any() or self.sines.any() or self.cosines.any())

    @property
    def is_constant(self) -> bool:
        """Whether x_r and u_r do not change in it."""
        return not (self.polynomial[1:].any() or self.sines.any() or self.cosines.any())

    def of_columns(self, columns: Sequence[int]) -> "ReferenceSegment":
        """Return the segment with some of its numbers; −1 is 0."""
        polynomial, sines, cosines = (
            np.hstack([rows, np.zeros((len(rows), 1))])[:, columns]
            for rows in (self.polynomial, self.sines, self.cosines)
        )
        return ReferenceSegment(self.begin_ns, polynomial, self.hz, sines, cosines)

    def at(self, t_s: float) -> Vector:
        """Return x_r and u_r at a time after the begin, (n + m,), as numpy computes them."""
        angle = 2 * math.pi * self.hz * t_s
        powers = t_s ** np.arange(len(self.polynomial))
        waves = np.sin(angle) @ self.sines + np.cos(angle) @ self.cosines
        return np.asarray(powers @ self.polynomial + waves)


class Reference:
    """x_r(t) and u_r(t).

    >>> reference = Reference.constant(np.array([1.0, 0.0]), np.array([3.0]))
    >>> reference.state(5_000_000_000)
    array([1., 0.])

    Args:
        segments: in the order of time; the first one begins at 0.
        n: number of states; further numbers of a row are inputs.
    """

    def __init__(self, segments: Sequence[ReferenceSegment], n: int) -> None:
        self.segments, self.n = tuple(segments), n
        self.since_ns = [segment.begin_ns for segment in segments[1:]]
        """Where one segment ends and the next begins."""
        self.core: CData = new_handle("reference", new_structure("noack_reference", self._numbers()))
        """The ``noack_reference``."""

    @classmethod
    def constant(cls, x_r: Vector, u_r: Vector) -> "Reference":
        """Return the reference of a set-point, (n,), with its input, (m,)."""
        row = np.concatenate([x_r, u_r])[None]
        return cls([ReferenceSegment(0, row, np.zeros(0), row[:0], row[:0])], len(x_r))

    @property
    def width(self) -> int:
        """Numbers of a row, n + m."""
        return int(self.segments[0].polynomial.shape[1])

    @property
    def is_constant(self) -> bool:
        """Whether x_r and u_r are the same at all times: a set-point."""
        return not self.since_ns and self.segments[0].is_constant

    def then(self, since_ns: int, reference: "Reference") -> "Reference":
        """Return this reference up to a time, and from then on another one, which is constant."""
        kept = [segment for segment in self.segments if segment.begin_ns < since_ns or not segment.begin_ns]
        (constant,) = reference.segments
        moved = ReferenceSegment(since_ns, constant.polynomial, constant.hz, constant.sines, constant.cosines)
        return Reference([*kept, moved], self.n)

    def of_states(self, n: int) -> "Reference":
        """Return the same reference of the first n states; the others of x_r are 0."""
        return Reference([segment.of_columns(self._columns(n)) for segment in self.segments], n)

    def _columns(self, n: int) -> list[int]:
        return [*range(n), *range(self.n, self.width)]

    def rows(self, t_ns: NDArray[np.int64]) -> Matrix:
        """Return [x_r, u_r] at times, (k, n + m)."""
        times = np.ascontiguousarray(t_ns, np.int64)
        result = np.zeros((len(times), self.width))
        core.noack_reference_rows(
            self.core, len(times), pointer_to(times, "int64_t *"), pointer_to(result, "double *")
        )
        return result

    def states(self, t_ns: NDArray[np.int64]) -> Matrix:
        """Return x_r at times, (k, n)."""
        return self.rows(t_ns)[:, : self.n]

    def state(self, t_ns: int) -> Vector:
        """Return x_r at a time, (n,)."""
        return self.rows(np.array([t_ns]))[0, : self.n]

    def in_segment(self, place: int, t_ns: int) -> Vector:
        """Return x_r of a segment at a time, (n,): at its end, the limit from the left."""
        result = np.zeros(self.n)
        core.noack_reference_part(self.core, place, t_ns, 0, self.n, pointer_to(result, "double *"))
        return result

    def input(self, t_ns: int) -> Vector:
        """Return u_r at a time, (m,)."""
        return self.rows(np.array([t_ns]))[0, self.n :]

    def _numbers(self) -> dict[str, object]:
        """Return the fields of a ``noack_reference``."""
        powers = max(len(segment.polynomial) for segment in self.segments)
        waves = max(len(segment.hz) for segment in self.segments)
        rows = np.zeros((len(self.segments), powers + 2 * waves, self.width))
        hz = np.zeros((len(self.segments), waves))
        for place, segment in enumerate(self.segments):
            rows[place, : len(segment.polynomial)] = segment.polynomial
            hz[place, : len(segment.hz)] = segment.hz
            rows[place, powers::2][: len(segment.hz)] = segment.sines
            rows[place, powers + 1 :: 2][: len(segment.hz)] = segment.cosines
        return {
            "width": self.width, "changes": len(self.since_ns), "powers": powers, "waves": waves,
            "since_ns": np.array(self.since_ns, np.int64), "hz": hz, "rows": rows,
        }  # fmt: skip


class ReferenceInForce:
    """The reference of a machine during a run, in which announced changes may move the set-point.

    Args:
        reference: at the start; None is 0.
        n: number of states.
        m: number of inputs.
    """

    def __init__(self, reference: Reference | None, n: int, m: int) -> None:
        self._zero = Reference.constant(np.zeros(n), np.zeros(m))
        self.reference = reference or self._zero
        self._last = self.reference
        self._before: list[Reference] = []
        """What models of the core may still follow."""

    @property
    def moves(self) -> bool:
        """Whether x_r or u_r is ever other than 0."""
        return not all(segment.is_zero for segment in self.reference.segments)

    def point(self, t_ns: int) -> tuple[Vector, Vector] | None:
        """Return x_r, (n,), and u_r, (m,), at a time; None if they are 0."""
        reference = self.reference
        if reference.segments[bisect_right(reference.since_ns, t_ns)].is_zero:
            return None
        return reference.state(t_ns), reference.input(t_ns)

    def difference(self, t_ns: int, x: Vector) -> Vector:
        """Return x − x_r at a time, (n,)."""
        point = self.point(t_ns)
        return x if point is None else x - point[0]

    def change(self, since_ns: int, reference: Reference | None) -> bool:
        """Follow another set-point from ``since_ns`` on; return whether it is another one."""
        reference = reference or self._zero
        if not reference.is_constant or np.array_equal(_row(reference), _row(self._last)):
            return False  # a reference that moves cannot change
        self._before.append(self.reference)
        self.reference, self._last = self.reference.then(since_ns, reference), reference
        return True


def _row(constant: Reference) -> Vector:
    row: Vector = constant.segments[0].polynomial[0]
    return row


class ModelFlow:
    """Propagates the state of the model, d(x − x_r)/dt = H(x − x_r), with H of (n, n), per second.

    ``reference`` is None if x_r is 0.
    """

    def __init__(self, H: Matrix, reference: Reference | None = None) -> None:
        self.propagate = Propagator(H)
        self.reference = reference

    def __call__(self, x: Vector, from_ns: int, to_ns: int) -> Vector:
        """Return the state at ``to_ns`` of a model with state ``x``, (n,), at ``from_ns``."""
        reference = self.reference
        if reference is None:
            return self.propagate(x, to_ns - from_ns)
        place = bisect_right(reference.since_ns, from_ns)
        while place < len(reference.since_ns) and reference.since_ns[place] < to_ns:
            x = self._follow(reference, place, x, from_ns, reference.since_ns[place])
            from_ns = reference.since_ns[place]
            place += 1
        return self._follow(reference, place, x, from_ns, to_ns)

    def _follow(self, reference: Reference, place: int, x: Vector, from_ns: int, to_ns: int) -> Vector:
        if reference.segments[place].is_zero or to_ns == from_ns:
            return self.propagate(x, to_ns - from_ns)
        start, end = (reference.in_segment(place, t_ns) for t_ns in (from_ns, to_ns))
        advanced: Vector = end + self.propagate(x - start, to_ns - from_ns)
        return advanced
