"""The models of many loops in arrays: what :class:`noack.core.model_flow.ModelFlow` does, compiled.

The matrices e^{H dt} are in a table with the model's number and dt as keys. What is missing there
is computed by :class:`Transitions`, outside compiled code.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, Propagator, Vector
from noack.core.ordered_arithmetic import multiply

MISSING = -1
"""The matrix is not in the table."""
STILL = -2
"""No time passes."""
STATIC = -3
"""H is 0."""
_PLACES = 1024


class ModelTable(NamedTuple):
    """Arrays of L loops with n states."""

    model: NDArray[np.int64]
    """(L,) The number of each loop's H."""
    static: NDArray[np.int64]
    """By model: 1 if H is 0."""
    keys: NDArray[np.int64]
    """(2P,) Model and dt in ns of each place of a hash table."""
    places: NDArray[np.int64]
    """(P,) Where its matrix begins in ``values``; MISSING: the place is free."""
    values: Vector
    setpoint: Vector
    """(L n,) x_r."""
    has_setpoint: NDArray[np.int64]
    """(L,)"""
    wanted: NDArray[np.int64]
    """(2,) Model and dt of the last matrix that was missing."""
    moved: Vector
    """(n,) Scratch."""


def find_transition(table: Any, loop: int, dt_ns: int) -> int:
    """Return where e^{H dt} of a loop begins in the table's values; or a constant above."""
    if dt_ns == 0:
        return STILL
    model = table.model[loop]
    if table.static[model] != 0:
        return STATIC
    last = len(table.places) - 1
    place = first_place(model, dt_ns, last)
    while table.places[place] != MISSING:
        if table.keys[2 * place] == model and table.keys[2 * place + 1] == dt_ns:
            return int(table.places[place])
        place = (place + 1) & last
    table.wanted[0] = model
    table.wanted[1] = dt_ns
    return MISSING


def first_place(model: int, dt_ns: int, last: int) -> int:
    """Return where the search for a matrix begins."""
    mixed = dt_ns ^ (dt_ns >> 17) ^ (dt_ns >> 31) ^ (model * 40_503)
    return int(mixed & last)


def advance_model(
    table: Any, loop: int, n: int, dt_ns: int, x: Any, begin: int, result: Any, into: int
) -> bool:
    """Compute a model's state after a time; return False if its matrix is not in the table.

    The arrays must not overlap.
    """
    found = find_transition(table, loop, dt_ns)
    if found == MISSING:
        return False
    shifts = table.has_setpoint[loop] != 0
    if found == STILL or (found == STATIC and not shifts):
        for k in range(n):
            result[into + k] = x[begin + k]
        return True
    if not shifts:
        multiply(table.values, found, x, begin, result, into, (n, n))
        return True
    for k in range(n):
        table.moved[k] = x[begin + k] - table.setpoint[loop * n + k]
        result[into + k] = table.moved[k]
    if found != STATIC:
        multiply(table.values, found, table.moved, 0, result, into, (n, n))
    for k in range(n):
        result[into + k] = table.setpoint[loop * n + k] + result[into + k]
    return True


def joined(parts: Iterable[Any], size: int) -> Vector:
    """Return the entries of the arrays of all loops, of ``size`` each; None is 0."""
    return np.concatenate(
        [np.zeros(size) if part is None else np.ravel(part).astype(np.float64) for part in parts]
    )


class Transitions:
    """Fills the table of matrices of L loops.

    Args:
        generators: H of each loop, (n, n).
        setpoints: x_r of each loop, (n,); None is 0.
        steps_ns: steps whose matrices are computed at once.
    """

    def __init__(
        self,
        generators: Sequence[Matrix],
        setpoints: Sequence[Vector | None],
        steps_ns: Iterable[int],
    ) -> None:
        numbers: dict[bytes, int] = {}
        model = [numbers.setdefault(H.tobytes(), len(numbers)) for H in generators]
        by_number = {number: H for H, number in zip(generators, model, strict=True)}
        self._propagators = [Propagator(by_number[number]) for number in range(len(numbers))]
        n = len(generators[0])
        self._entries = 0
        self.table = ModelTable(
            model=np.array(model, np.int64),
            static=np.array([not H.generator.any() for H in self._propagators], np.int64),
            keys=np.zeros(2 * _PLACES, np.int64),
            places=np.full(_PLACES, MISSING, np.int64),
            values=np.zeros(_PLACES // 2 * n * n),
            setpoint=joined(setpoints, n),
            has_setpoint=np.array([x_r is not None for x_r in setpoints], np.int64),
            wanted=np.zeros(2, np.int64),
            moved=np.zeros(n),
        )
        for number in range(len(numbers)):
            for dt_ns in sorted(set(steps_ns)):
                self.add(number, dt_ns)

    def add(self, model: int, dt_ns: int) -> None:
        """Compute a matrix and store it; ``table`` may be another afterwards."""
        if find_transition(self.table, int(np.argmax(self.table.model == model)), dt_ns) != MISSING:
            return
        table, n = self.table, len(self.table.moved)
        if 2 * (self._entries + 1) > len(table.places):
            self._grow()
            table = self.table
        begin = self._entries * n * n
        table.values[begin : begin + n * n] = self._propagators[model].transition(dt_ns).ravel()
        self._insert(model, dt_ns, begin)
        self._entries += 1

    def add_wanted(self) -> None:
        """Compute the matrix that was missing last."""
        model, dt_ns = self.table.wanted.tolist()
        self.add(model, dt_ns)

    def _insert(self, model: int, dt_ns: int, begin: int) -> None:
        table, last = self.table, len(self.table.places) - 1
        place = first_place(model, dt_ns, last)
        while table.places[place] != MISSING:
            place = (place + 1) & last
        table.keys[2 * place : 2 * place + 2] = model, dt_ns
        table.places[place] = begin

    def _grow(self) -> None:
        old = self.table
        self.table = old._replace(
            keys=np.zeros(2 * len(old.keys), np.int64),
            places=np.full(2 * len(old.places), MISSING, np.int64),
            values=np.concatenate([old.values, np.zeros_like(old.values)]),
        )
        for place in np.flatnonzero(old.places != MISSING).tolist():
            model, dt_ns = old.keys[2 * place : 2 * place + 2].tolist()
            self._insert(model, dt_ns, int(old.places[place]))
