"""Memory of the core's structures: arrays that live as long as what points to them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from noack.core.core_library import Array, CData, core, ffi, pointer_to
from noack.core.linear_systems import SCRATCH_MATRICES, Matrix, Vector

_MOST_PLACES, _MOST_NUMBERS = 1024, 2**20


class CoreMemory:
    """Arrays that structures of the core point to.

    >>> memory = CoreMemory()
    >>> x = memory.reals([1.0, 2.0])
    >>> x[1]
    2.0
    """

    def __init__(self) -> None:
        self._kept: list[Any] = []
        self._transitions: dict[bytes, CData] = {}
        self._shared: list[Array] = []

    def keep(self, owner: Any) -> Any:
        """Keep an object alive as long as this memory; return it."""
        self._kept.append(owner)
        return owner

    def reals(self, values: ArrayLike) -> CData:
        """Return a pointer to a copy of numbers, ``double *``."""
        return self._pointer(np.array(values, np.float64, order="C"), "double *")

    def integers(self, values: ArrayLike) -> CData:
        """Return a pointer to a copy of whole numbers, ``int64_t *``."""
        return self._pointer(np.array(values, np.int64, order="C"), "int64_t *")

    def zeros(self, count: int) -> CData:
        """Return a pointer to zeros, ``double *``; memory is taken when it is first used."""
        return self._pointer(np.zeros(max(count, 1)), "double *")

    def transitions(self, H: Matrix, steps_ns: Iterable[int] = ()) -> CData:
        """Return the ``noack_transitions *`` of H, (n, n); loops with the same H share it.

        The matrices of ``steps_ns`` are computed at once, so that first deadlines are not delayed.
        """
        H = np.array(H, np.float64, order="C")
        shared = self._transitions.get(H.tobytes())
        if shared is None:
            shared = self._transitions[H.tobytes()] = self._new_transitions(H)
        if not shared.is_static:
            for step_ns in steps_ns:
                if step_ns > 0:
                    core.noack_transition(shared, step_ns)
        return shared

    def set_model(
        self,
        model: CData,
        transitions: CData,
        since_ns: Iterable[int] = (),
        points: Iterable[Vector | None] = (None,),
    ) -> None:
        """Fill a ``noack_model``: its set points x_r, and the times at which they change."""
        since, known = list(since_ns), list(points)
        n = transitions.n
        model.transitions, model.changes = transitions, len(since)
        model.since_ns = self.integers(since or [0])
        model.has_point = self.integers([point is not None for point in known])
        model.points = self.reals([np.zeros(n) if point is None else point for point in known])

    def fill(self, structure: CData, numbers: Mapping[str, Any]) -> None:
        """Set fields of a structure; an array becomes a pointer to a copy of it."""
        for name, number in numbers.items():
            value = self.reals(number) if isinstance(number, np.ndarray) else number
            setattr(structure, name, ffi.NULL if value is None else value)

    @property
    def size(self) -> int:
        """What is kept: a mark for :meth:`copy`."""
        return len(self._kept)

    def copy(self, structures: CData, first: int, others: Sequence[int], mark: int) -> None:
        """Make structures of an array copies of one of them, each with arrays of its own.

        Args:
            structures: the array of structures.
            first: number of the one that has been filled, since ``mark``.
            others: numbers of those that become like it; they share its transition matrices.
            mark: the size of this memory before it was filled.
        """
        arrays = [kept.reshape(-1) for kept in self._kept[mark:] if isinstance(kept, np.ndarray)]
        ends = [*accumulate(map(len, arrays), initial=0)]
        own = np.empty((len(others), ends[-1] + 1), np.uint64)
        own[:, : ends[-1]] = np.concatenate([array.view(np.uint64) for array in arrays])
        self._kept.append(own)
        words = np.frombuffer(ffi.buffer(structures), np.uint64).reshape(len(structures), -1)
        copies = np.repeat(words[None, first], len(others), axis=0)
        starts = {array.ctypes.data: end for array, end in zip(arrays, ends[:-1], strict=True)}
        for word in _pointer_words(ffi.typeof(structures).item):
            if (start := starts.get(int(words[first, word]))) is not None:
                copies[:, word] = own.ctypes.data + start * 8 + own.strides[0] * np.arange(len(own))
        words[others] = copies

    def _new_transitions(self, H: Matrix) -> CData:
        n = len(H)
        fits = max(_MOST_NUMBERS // (n * n), 4)
        places = min(_MOST_PLACES, 1 << fits.bit_length() - 1)
        made = ffi.new("noack_transitions *", {"n": n, "is_static": not H.any(), "places": places})
        steps_ns, matrices = np.zeros(places, np.int64), np.zeros(places * n * n)
        scratch = np.zeros(SCRATCH_MATRICES * n * n + 3 * n)
        made.H, made.steps_ns = pointer_to(H, "double *"), pointer_to(steps_ns, "int64_t *")
        made.matrices, made.scratch = (
            pointer_to(array, "double *") for array in (matrices, scratch)
        )
        self._shared += [H, steps_ns, matrices, scratch]
        return made

    def _pointer(self, array: Array, kind: str) -> CData:
        self._kept.append(array)
        return ffi.cast(kind, array.ctypes.data)


@cache
def _pointer_words(kind: CData) -> tuple[int, ...]:
    """Return the places of the pointers in a structure of words of 64 bits, e.g. noack_plant."""
    words: list[int] = []
    for _, field in kind.fields:
        word = field.offset // 8
        if field.type.kind == "pointer":
            words.append(word)
        elif field.type.kind == "struct":
            words += (word + inner for inner in _pointer_words(field.type))
    return tuple(words)


def reals_at(pointer: CData, *shape: int) -> NDArray[np.float64]:
    """Return the numbers at a ``double *`` as an array, which shares their memory."""
    data = ffi.buffer(pointer, 8 * math.prod(shape))
    return np.frombuffer(data, np.float64).reshape(shape)
