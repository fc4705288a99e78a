"""A loop document as floating-point numbers: what a comparison needs of it, computed once for all runs.

It is as trusted as ``conformance.py``, which reads it. Of an interval it has the middle.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix

Table = Mapping[str, Any]
TINY = 1e-12
_PARTS = 8


class SignalLimits(NamedTuple):
    """What bounds an unknown signal p: |p| ≤ Σ λᵢ |Rᵢ z|, and perhaps p · Cz ≥ k p²."""

    rows: Sequence[Matrix]
    """Rᵢ by corner; a single one if all corners have the same."""
    along: Matrix | None
    """C, (1, coordinates)."""
    least: float


class MotionParts(NamedTuple):
    """A motion ż = F z + B u + Σ c p with u = Σ λᵢ Uᵢ z."""

    F: Matrix
    B: Matrix
    U: Sequence[Matrix]
    columns: Matrix
    signals: Sequence[SignalLimits]


class MotionStep(NamedTuple):
    """What a motion does in a time: ``state`` z + ``input`` u + ``signals`` p, of constant u and p."""

    state: Matrix
    input: Matrix
    signals: Matrix
    varied: Matrix
    """By how much a varying signal of size 1 may move z otherwise than a constant one, (n, signals)."""


class DocumentNumbers:
    """A loop document, and its matrices as numbers.

    Args:
        table: the document, which must not change.
    """

    def __init__(self, table: Table) -> None:
        self.table = table
        self.names = [coordinate["name"] for coordinate in table["coordinates"]]
        self.noise = [i for i, c in enumerate(table["coordinates"]) if c.get("noise")]
        self.states = [i for i in range(len(self.names)) if i not in self.noise]
        self.locations = {location["name"]: location for location in table["locations"]}
        self.edges = {edge["name"]: edge for edge in table["edges"]}
        self.place_numbers = {name: number for number, name in enumerate(self.locations)}
        decaying = table.get("decaying")
        self.units = [decaying["coordinate"] if decaying else "", table.get("constant") or ""]

    @cached_method
    def rows(self, name: str) -> Matrix:
        """Return the rows of a name."""
        return _matrix(self.table["rows"][name])

    @cached_method
    def jump(self, edge: str) -> Matrix:
        """Return J of an edge."""
        return _matrix(self.edges[edge]["jump"])

    @cached_method
    def start(self) -> Matrix:
        """Return z(0), and what each noise coordinate adds to it."""
        return _matrix(self.table["start"]["columns"])

    @cached_method
    def readings(self) -> Mapping[str, Sequence[tuple[Matrix, Sequence[str]]]]:
        """Return of each reading its rows, and the locations in which these count."""
        return {
            name: [(_matrix(part["rows"]), part["in"]) for part in parts]
            for name, parts in self.table["readings"].items()
        }

    @cached_method
    def outside(self, location: str) -> Sequence[int]:
        """Return the states that a location lacks, but for the units."""
        has = (*self.locations[location]["coordinates"], *self.units)
        return [i for i in self.states if self.names[i] not in has]

    @cached_method
    def split(self, motion: str) -> MotionParts | None:
        """Return the parts of a motion; None: its corners have no common part, or other signals."""
        corners = self.table["motions"][motion]
        moved = [[{**each, "rows": None} for each in corner["unknown"]] for corner in corners]
        if any(each != moved[0] for each in moved):
            return None
        F = [_matrix(corner["matrix"]) for corner in corners]
        U = [_matrix(corner["input"]) for corner in corners]
        unknown = corners[0]["unknown"]
        columns = np.hstack([_matrix(each["column"]) for each in unknown] or [np.zeros((len(F[0]), 0))])
        signals = [_limits([corner["unknown"][k] for corner in corners]) for k in range(len(unknown))]
        if len(corners) == 1:  # then u is U z, and F has its part
            return MotionParts(F[0], np.zeros((len(F[0]), len(U[0]))), U, columns, signals)
        mean_F, mean_U = sum(F) / len(F), sum(U) / len(U)
        differences = np.hstack([each - mean_U for each in U]), np.hstack([each - mean_F for each in F])
        B = differences[1] @ np.linalg.pinv(differences[0])
        if np.abs(B @ differences[0] - differences[1]).max(initial=0) > 1e-6 * (np.abs(mean_F).max() + TINY):
            return None
        return MotionParts(np.asarray(mean_F - B @ mean_U), B, U, columns, signals)

    @cached_method
    def flow(self, motion: str, length_s: float) -> MotionStep:
        """Return what a motion that has a split does in a time."""
        split = self.split(motion)
        assert split is not None
        n, m, k = len(split.F), split.B.shape[1], split.columns.shape[1]
        whole = np.zeros((n + m + k, n + m + k))
        whole[:n, :n], whole[:n, n : n + m], whole[:n, n + m :] = split.F, split.B, split.columns
        moved = expm(whole * length_s)[:n]
        return MotionStep(moved[:, :n], moved[:, n : n + m], moved[:, n + m :], _variation(split, length_s))


def _limits(by_corner: Sequence[Table]) -> SignalLimits:
    """Return what bounds a signal, of its entries in all corners."""
    first = by_corner[0]
    is_same = all(each["rows"] == first["rows"] for each in by_corner)
    rows = [_matrix(each["rows"]) for each in (by_corner[:1] if is_same else by_corner)]
    along = _matrix(first["along"]) if "along" in first else None
    return SignalLimits(rows, along, value(first.get("least", 0)))


def _variation(split: MotionParts, length_s: float) -> Matrix:
    """Return :attr:`MotionStep.varied`.

    Its effect is ∫ g p ds with g = e^{F(T − s)} c, so this is ∫ |g − mean of g| ds.
    """
    parts = np.linspace(0.0, length_s, 2 * _PARTS + 1)[1::2]
    effects = np.stack([expm(split.F * s) @ split.columns for s in parts])
    return np.asarray(length_s * np.abs(effects - effects.mean(axis=0)).mean(axis=0))


def value(entry: Any) -> float:
    """Return an entry of a document as a number."""
    if isinstance(entry, list):
        return (value(entry[0]) + value(entry[1])) / 2
    return float(Fraction(entry)) if isinstance(entry, str) else float(entry)


def _matrix(rows: Sequence[Sequence[Any]]) -> Matrix:
    try:
        plain = np.array(rows, dtype=float)
    except ValueError:  # it has quotients or intervals
        plain = np.zeros(0)
    if plain.ndim == 2:
        return plain
    return np.array([[value(entry) for entry in row] for row in rows], dtype=float)
