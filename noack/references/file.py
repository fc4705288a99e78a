"""A reference from a CSV file: all states and inputs at given times."""

import csv
import math
from collections.abc import Sequence
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from netem.core.clock import NS_PER_S
from netem.core.errors import shortened
from netem.core.named_file import NamedFile
from netem.core.settings_section import Positive
from noack.core.linear_systems import Matrix, transition
from noack.core.references import ReferenceSegment
from noack.references.piece_settings import PieceSettings, TimeS
from noack.settings.values import Row, rows_of

MOST_ROWS = 100_000
TIME = "t_s"


class FilePiece(PieceSettings):
    """x_r and u_r at given times; between them u_r is linear, and x_r the solution of the model."""

    kind: Literal["file"]
    file: Annotated[str, Field(min_length=1)] | None = None
    """A CSV file with the columns t_s, the names of the states and those of the inputs. A relative
    name is relative to the scenario file. Loading the scenario replaces the name by the numbers."""
    tolerance: Positive = 1e-6
    """Largest difference between a row and the model's solution from the row before, and between
    that solution and the curve that the loop follows, as a share of the state's largest value."""
    t_s: Annotated[tuple[TimeS, ...], Field(min_length=2, max_length=MOST_ROWS)] | None = None
    """The times, from 0 to the horizon at least."""
    x: Annotated[tuple[Row, ...], Field(min_length=2, max_length=MOST_ROWS)] | None = None
    """The states, a row for each time."""
    u: Annotated[tuple[Row, ...], Field(min_length=2, max_length=MOST_ROWS)] | None = None
    """The inputs, a row for each time."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if [self.t_s, self.x, self.u].count(None) != (0 if self.file is None else 3):
            raise ValueError("file: give a file, or the numbers t_s, x and u")
        return self

    def read(self, file: NamedFile, states: Sequence[str], inputs: Sequence[str]) -> Self:
        """Return the piece with the numbers of its file, whose columns are t_s, ``states`` and ``inputs``.

        Raises:
            CallerError: the file cannot be read, or its columns or numbers do not fit.
        """
        lines = csv.reader(file.content().decode("utf-8-sig", errors="replace").splitlines())
        header, names = [name.strip() for name in next(lines, [])], [TIME, *states, *inputs]
        if sorted(header) != sorted(names):
            found = shortened(", ".join(header)) or "none"
            file.wrong(f"needs the columns {', '.join(names)}; it has {found}")
        order, rows = [header.index(name) for name in names], list[list[float]]()
        for number, line in enumerate(lines, 2):
            if line:
                rows.append([_number(file, number, line, header, place) for place in order])
        if not 2 <= len(rows) <= MOST_ROWS:
            file.wrong(f"has {len(rows)} rows of numbers; expected 2 to {MOST_ROWS:,}")
        numbers, n = np.array(rows), len(states) + 1
        update = {"t_s": tuple(numbers[:, 0].tolist()), "file": None}
        return self.model_copy(update=update | {"x": rows_of(numbers[:, 1:n]), "u": rows_of(numbers[:, n:])})

    def check(self, A: Matrix, B: Matrix, horizon_s: float, states: Sequence[str]) -> None:
        """Raise ValueError unless the numbers are a solution of ẋ = Ax + Bu; ``states`` names those of x."""
        assert self.t_s is not None
        assert self.x is not None
        assert self.u is not None
        for name, rows, width in (("x", self.x, len(A)), ("u", self.u, len(B.T))):
            if len(rows) != len(self.t_s) or any(len(row) != width for row in rows):
                raise ValueError(f"{name}: expected {len(self.t_s)} rows of {width} numbers")
        t_s = np.array(self.t_s)
        close = np.flatnonzero(np.diff(t_s) < 1e-6)
        if t_s[0] != 0 or t_s[-1] < horizon_s or len(close):
            found = f"{t_s[0]:g} to {t_s[-1]:g} s"
            if len(close):
                found = f"{t_s[close[0]]:.9g} s in row {close[0] + 1}, then {t_s[close[0] + 1]:.9g} s"
            raise ValueError(
                f"{TIME}: expected ascending times from 0 to the horizon, {horizon_s:g} s, at least "
                f"1 us apart; found {found}"
            )
        self._require_solution(A, B, states)

    def _require_solution(self, A: Matrix, B: Matrix, states: Sequence[str]) -> None:
        """Compare each row, and the curve half-way to it, with the solution from the row before."""
        n, x, u = len(A), np.array(self.x), np.array(self.u)
        scale = np.maximum(np.abs(x).max(axis=0), np.finfo(float).tiny)
        steps = dict[int, tuple[Matrix, Matrix]]()
        for row, segment in enumerate(self.segments(A, B)[:-1]):
            end_ns = round((self.t_s or ())[row + 1] * NS_PER_S)
            length_ns = end_ns - segment.begin_ns
            if length_ns not in steps:
                steps[length_ns] = (_step(A, B, length_ns), _step(A, B, length_ns / 2))
            slope = (u[row + 1] - u[row]) / (length_ns * 1e-9)
            start = np.concatenate([x[row], u[row], slope])
            half_s = length_ns * 0.5e-9
            curve = half_s ** np.arange(4) @ segment.polynomial[:, :n]
            with np.errstate(over="ignore", invalid="ignore"):
                errors = [steps[length_ns][0] @ start - x[row + 1], steps[length_ns][1] @ start - curve]
            for error, place in zip(errors, ("", "the curve half-way to "), strict=True):
                if not (np.abs(error) <= self.tolerance * scale).all():
                    worst = int(np.argmax(np.abs(error) / scale))
                    allowed = self.tolerance * scale[worst]
                    at_s = end_ns / NS_PER_S
                    raise ValueError(
                        f"x: not a solution of the model: in {place}row {row + 2}, t = {at_s:g} s, "
                        f"{states[worst]} is off by {abs(error[worst]):.3g}; tolerance allows {allowed:.3g}"
                    )

    def segments(self, A: Matrix, B: Matrix) -> list[ReferenceSegment]:
        """Return a segment for each time: cubic with the slopes Ax + Bu; the last one is constant."""
        t_ns = np.round(np.array(self.t_s) * NS_PER_S).astype(np.int64)
        x, u = np.array(self.x), np.array(self.u)
        slopes, h = x @ A.T + u @ B.T, np.diff(t_ns)[:, None] * 1e-9
        rise = np.diff(x, axis=0) / h
        square = (3 * rise - 2 * slopes[:-1] - slopes[1:]) / h
        cube = (slopes[:-1] + slopes[1:] - 2 * rise) / h**2
        zeros = np.zeros_like(u[1:])
        powers = [(x[:-1], u[:-1]), (slopes[:-1], np.diff(u, axis=0) / h), (square, zeros), (cube, zeros)]
        rows = np.stack([np.hstack(pair) for pair in powers], axis=1)
        nothing = np.zeros((0, rows.shape[2]))
        last = np.concatenate([x[-1], u[-1]])[None]
        return [
            ReferenceSegment(begin_ns, polynomial, np.zeros(0), nothing, nothing)
            for begin_ns, polynomial in zip(t_ns.tolist(), [*rows, last], strict=True)
        ]


def _step(A: Matrix, B: Matrix, length_ns: float) -> Matrix:
    """Return the step of x from [x; u; u̇] with constant u̇, (n, n + 2m)."""
    n, m = B.shape
    system = np.zeros((n + 2 * m, n + 2 * m))
    system[:n, :n], system[:n, n : n + m], system[n : n + m, n + m :] = A, B, np.eye(m)
    return transition(system, length_ns)[:n]


def _number(file: NamedFile, number: int, line: Sequence[str], header: Sequence[str], place: int) -> float:
    """Return the number in a field of a line."""
    try:
        value = float(line[place])
    except (ValueError, IndexError):
        value = math.nan
    if not math.isfinite(value) or len(line) != len(header):
        text = shortened(",".join(line), 60)
        file.wrong(f"line {number}: expected {len(header)} finite numbers, found {text!r}")
    return value
