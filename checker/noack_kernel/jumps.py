"""Edges that last: the product of their steps in balls, and what an output does during them.

A step sets z := M z at once, or z := e^{Fs} z over s seconds; some steps may be repeated. On a part of a flow
from a to b, of length δ, y = C e^{F(θ−a)} z(a) is nearly linear: each entry of the row differs from the chord
by at most w = δ²/8 · sup |C F² e^{F(θ−a)}|. So y(θ) = r z + e z with r on the chord and |eⱼ| ≤ wⱼ, and

    |y|² ≤ (1 + a)|r z|² + (1 + 1/a)|e z|²,    |e z|² ≤ k Σ wⱼ² zⱼ²   (k of the wⱼ are not 0).

Both are convex in r, so the ends of the chord suffice.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from flint import arb, arb_mat, fmpq, fmpq_mat

from noack_kernel.exact import Matrix, RejectedError, exponential, from_balls, power, to_balls, unit_rows

MOST_SUB_STEPS = 20_000
"""Of all flows of an edge."""


class Step(NamedTuple):
    """z := ``matrix`` z at once, or z := e^{``matrix`` s} z over so many ``seconds``."""

    name: str
    matrix: Matrix
    seconds: fmpq | None


class Repeat(NamedTuple):
    """Steps, in order of time, which are taken so many times one after the other."""

    steps: tuple[Step, ...]
    times: int

    @property
    def seconds(self) -> fmpq:
        """How long they last together, s."""
        return duration_of(self.steps) * self.times


Steps = Sequence[Step | Repeat]
Key = tuple[object, ...]


def duration_of(steps: Steps) -> fmpq:
    """Return the sum of the steps' times, s."""
    return sum((step.seconds for step in steps if step.seconds is not None), fmpq(0))


def each_step(steps: Steps) -> Iterator[Step]:
    """Yield all steps in order of time, the repeated ones again and again."""
    for step in steps:
        if isinstance(step, Repeat):
            for _ in range(step.times):
                yield from step.steps
        else:
            yield step


class SubStep(NamedTuple):
    """|y|² ≤ (1 + a)|r z|² + (1 + 1/a) zᵀ ``beyond`` z for r between ``ends``, on a part of a flow."""

    end: fmpq
    """Time since the beginning of the edge, s."""
    ends: tuple[Matrix, Matrix]
    """The rows at both ends, of z at the beginning of the edge."""
    beyond: Matrix


class Products:
    """The products of steps. What is computed once is kept."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._flows: dict[tuple[str, fmpq], arb_mat] = {}
        self._products: dict[Key, Matrix] = {}

    def of(self, steps: Steps) -> Matrix:
        """Return the product of steps, which are in order of time."""
        key = _key(steps)
        if key not in self._products:
            self._products[key] = from_balls(self._product(steps))
        return self._products[key]

    def _product(self, steps: Steps) -> arb_mat:
        found = self._identity()
        for step in steps:
            if isinstance(step, Repeat):
                found = power(self._product(step.steps), step.times) * found
            else:
                found = self._map(step) * found
        return found

    def _identity(self) -> arb_mat:
        return to_balls(unit_rows(range(self._size), self._size))

    def _map(self, step: Step) -> arb_mat:
        if step.seconds is None:
            return to_balls(step.matrix)
        return self._flow(step, step.seconds)

    def _flow(self, step: Step, seconds: fmpq) -> arb_mat:
        key = step.name, seconds
        if key not in self._flows:
            self._flows[key] = exponential(step.matrix, arb(seconds))
        return self._flows[key]

    def during(self, steps: Steps, rows: Matrix, longest: fmpq) -> Iterator[SubStep]:
        """Yield an output on each part of each flow.

        Args:
            steps: of an edge, in order of time.
            rows: C in y = C z.
            longest: the longest part, s.

        Raises:
            RejectedError: the parts are too many, or not above 0.
        """
        if not longest > 0:
            raise RejectedError("a sub-step is not above 0")
        C, before, time, count = to_balls(rows), self._identity(), fmpq(0), 0
        for step in each_step(steps):
            if step.seconds is not None and step.seconds > 0:
                parts = int((step.seconds / longest).ceil())
                count += parts
                if count > MOST_SUB_STEPS:
                    raise RejectedError(f"more than {MOST_SUB_STEPS} sub-steps in an edge")
                part = step.seconds / parts
                F, over = to_balls(step.matrix), self._flow(step, part)
                within = exponential(step.matrix, arb(part / 2, arb(part / 2).upper()))
                bend = C * F * F * within * (arb(part) * arb(part) / 8)
                at, start = before, from_balls(C * before)
                for number in range(1, parts + 1):
                    beyond, at = _beyond(from_balls(bend * at)), over * at
                    end = from_balls(C * at)
                    yield SubStep(time + part * number, (start, end), beyond)
                    start = end
                time += step.seconds
            before = self._map(step) * before


def _key(steps: Steps) -> Key:
    return tuple(
        (_key(step.steps), step.times) if isinstance(step, Repeat) else (step.name, step.seconds)
        for step in steps
    )


def _beyond(bend: Matrix) -> Matrix:
    """Return a matrix B with |e z|² ≤ zᵀBz for all rows e whose entries are at most those of ``bend``."""
    found = fmpq_mat(bend.width, bend.width)
    for i in range(bend.height):
        sizes = [abs(entry) for entry in bend.mid.tolist()[i]]
        if bend.radius is not None:
            sizes = [a + b for a, b in zip(sizes, bend.radius.tolist()[i], strict=True)]
        count = sum(size != 0 for size in sizes)
        for j, size in enumerate(sizes):
            found[j, j] += count * size * size
    return Matrix(found)
