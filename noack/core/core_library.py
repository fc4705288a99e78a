"""The core in C (native/): its functions, numpy's row types of its structures, and their memory.

The library is built ahead of time, by ``make setup`` or with the wheel. Nothing is compiled here.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import accumulate
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from noack.core.errors import CallerError

LIBRARY = Path(__file__).with_name("libnoack.so")
T = TypeVar("T")
CData = Any
"""A structure or pointer of the core: mypy does not know its fields."""
AnyArray = NDArray[np.generic]
"""Numbers, or rows of a structure of the core."""
StructRows = NDArray[np.void]
"""Rows of a structure of the core."""
Reals = NDArray[np.float64]
SCRATCH_MATRICES = 10
"""Matrices of a matrix's size that the core needs for scratch, for its exponential."""
_MOST_PLACES, _MOST_NUMBERS = 1024, 2**20
"""Maximum number of matrices that transitions keep, and of their entries."""
_REMEDY = "run `make setup` in the repository, or install noack again"

try:
    from noack.core._core_header import SOURCES as SOURCES
    from noack.core._core_header import ffi as ffi
except ImportError:
    raise CallerError(f"noack's core in C has not been built; {_REMEDY}") from None


def load_core(path: Path) -> CData:
    """Return the functions and constants of the public headers in a library.

    Raise CallerError if there is no library that goes with the declarations.
    """
    try:
        library = ffi.dlopen(str(path))
        built_from = ffi.string(library.noack_sources()).decode()
    except (OSError, ffi.error) as error:
        reason = str(error).rpartition("': ")[2]  # begins with the path
        raise CallerError(f"noack's core in C cannot be loaded: {reason}; {_REMEDY}") from None
    if built_from != SOURCES:
        raise CallerError(f"{path}: was built from other sources than its declarations; {_REMEDY}")
    return library


core: CData = load_core(LIBRARY)
"""The functions and constants of the headers native/**/public.h."""


def require_live_runs() -> None:
    """Raise CallerError where there are no live runs: the core has its sockets on Linux only."""
    if not hasattr(core, "noack_drive"):
        raise CallerError(
            "live runs and the network emulator need Linux; `noack simulate` runs the same loop in "
            "virtual time"
        )


_FORMATS = {
    "int64_t": "<i8",
    "int32_t": "<i4",
    "uint8_t": "u1",
    "uint16_t": "<u2",
    "uint32_t": "<u4",
    "uint64_t": "<u8",
    "double": "<f8",
}


@cache
def dtype_of(name: str) -> np.dtype[np.void]:
    """Return the row type of a structure of a public header that has numbers and their arrays only.

    >>> dtype_of("noack_window").names
    ('losses', 'packets')
    """
    kind = ffi.typeof(name)
    return np.dtype(
        {
            "names": [field for field, _ in kind.fields],
            "formats": [_format_of(of.type) for _, of in kind.fields],
            "offsets": [of.offset for _, of in kind.fields],
            "itemsize": ffi.sizeof(kind),
        }
    )


def _format_of(kind: CData) -> DTypeLike:
    if kind.kind == "array":
        return _format_of(kind.item), (kind.length,)
    return _FORMATS[kind.cname]


def pointer_to(array: AnyArray, kind: str) -> CData:
    """Return a pointer to the rows of a contiguous array, e.g. of kind ``"noack_flow *"``.

    It is valid while the array lives.
    """
    if not array.flags.c_contiguous:
        raise ValueError("the core takes contiguous arrays")
    return ffi.cast(kind, ffi.from_buffer(array))  # faster than numpy's address


def new_handle(kind: str, *arguments: object) -> CData:
    """Return a new ``noack_KIND *`` of the core, which is freed with the object returned.

    Args:
        kind: what it is, e.g. ``"link"``.
        arguments: those of its function ``noack_KIND_new``.

    Raises:
        ValueError: the core refuses the arguments; the text says why.
        MemoryError: there is no memory.
    """
    wrong = ffi.new("const char **")
    handle = getattr(core, f"noack_{kind}_new")(*arguments, wrong)
    require(handle != ffi.NULL, wrong, kind)
    return ffi.gc(handle, getattr(core, f"noack_{kind}_free"))


def require(done: bool, wrong: CData, kind: str) -> None:
    """Raise ValueError with the text that the core has set, or MemoryError, unless a call was ``done``."""
    if not done:
        if wrong[0] == ffi.NULL:
            raise MemoryError
        raise ValueError(f"{kind}: {ffi.string(wrong[0]).decode()}")


def address_of(pointer: CData) -> int:
    """Return the address that a pointer of the core has."""
    return int(ffi.cast("intptr_t", pointer))


class CoreMemory:
    """Arrays that structures of the core point to.

    >>> memory = CoreMemory()
    >>> x = memory.reals([1.0, 2.0])
    >>> x[1]
    2.0
    """

    def __init__(self) -> None:
        self._owners: list[object] = []
        self._transitions: dict[bytes, CData] = {}
        self._shared: list[AnyArray] = []

    def keep(self, owner: T) -> T:
        """Keep an object alive as long as this memory; return it."""
        self._owners.append(owner)
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

    def transitions(self, H: Reals, steps_ns: Iterable[int] = ()) -> CData:
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

    def fill(self, structure: CData, numbers: Mapping[str, object]) -> None:
        """Set fields of a structure; an array becomes a pointer to a copy of it."""
        for name, number in numbers.items():
            value = self.reals(number) if isinstance(number, np.ndarray) else number
            setattr(structure, name, ffi.NULL if value is None else value)

    @property
    def mark(self) -> int:
        """How much this memory keeps now; :meth:`copy` copies what was added since."""
        return len(self._owners)

    def copy(self, structures: CData, first: int, others: Sequence[int], mark: int) -> None:
        """Make structures of an array copies of one of them, each with arrays of its own.

        Args:
            structures: the array of structures.
            first: number of the one that has been filled, since ``mark``.
            others: numbers of those that become like it; they share its transition matrices.
            mark: that of this memory before it was filled.
        """
        arrays = [owner.reshape(-1) for owner in self._owners[mark:] if isinstance(owner, np.ndarray)]
        ends = [*accumulate(map(len, arrays), initial=0)]
        copied = np.empty((len(others), ends[-1] + 1), np.uint64)
        copied[:, : ends[-1]] = np.concatenate([array.view(np.uint64) for array in arrays])
        self._owners.append(copied)
        words = np.frombuffer(ffi.buffer(structures), np.uint64).reshape(len(structures), -1)
        copies = np.repeat(words[None, first], len(others), axis=0)
        starts = {array.ctypes.data: end for array, end in zip(arrays, ends[:-1], strict=True)}
        for word in _pointer_words(ffi.typeof(structures).item):
            if (start := starts.get(int(words[first, word]))) is not None:
                copies[:, word] = copied.ctypes.data + start * 8 + copied.strides[0] * np.arange(len(copied))
        words[others] = copies

    def _new_transitions(self, H: Reals) -> CData:
        n = len(H)
        most_places = max(_MOST_NUMBERS // (n * n), 4)
        places = min(_MOST_PLACES, 1 << most_places.bit_length() - 1)
        transitions = ffi.new("noack_transitions *", {"n": n, "is_static": not H.any(), "places": places})
        steps_ns, matrices = np.zeros(places, np.int64), np.zeros(places * n * n)
        scratch = np.zeros(SCRATCH_MATRICES * n * n + 3 * n)
        transitions.H, transitions.steps_ns = pointer_to(H, "double *"), pointer_to(steps_ns, "int64_t *")
        transitions.matrices, transitions.scratch = (
            pointer_to(array, "double *") for array in (matrices, scratch)
        )
        self._shared += [H, steps_ns, matrices, scratch]
        return transitions

    def _pointer(self, array: AnyArray, kind: str) -> CData:
        self._owners.append(array)
        return pointer_to(array, kind)


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


def reals_at(pointer: CData, *shape: int) -> Reals:
    """Return the numbers at a ``double *`` as an array, which shares their memory."""
    data = ffi.buffer(pointer, 8 * math.prod(shape))
    return np.frombuffer(data, np.float64).reshape(shape)


def rows_at(pointer: CData, count: int) -> StructRows:
    """Return the rows of a structure at a pointer as an array, which shares their memory."""
    kind = dtype_of(ffi.typeof(pointer).item.cname)
    return np.frombuffer(ffi.buffer(pointer, count * kind.itemsize), kind)
