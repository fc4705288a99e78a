"""The network's library in C (native/): its functions, its handles, and numpy's row types of its structures.

The library is built ahead of time, by ``make setup`` or with the wheel. Nothing is compiled here. The
loop has a library of its own, :mod:`noack.core.core_library`.

The structures of most handles are public, since Python reads and writes fields of them between two
calls: it takes rows and counters, answers what a step has asked, and sets descriptors, limits and new
settings. Python needs no field of the exact simulation and of the transitions: these are opaque.
"""

import math
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import DTypeLike, NDArray

from netem.core.errors import CallerError

CData = Any
"""A structure or pointer of the core: mypy does not know its fields."""
AnyArray = NDArray[np.generic]
"""Numbers, or rows of a structure of the core."""
StructRows = NDArray[np.void]
"""Rows of a structure of the core."""
Reals = NDArray[np.float64]
REMEDY = "run `make setup` in the repository, or install noack again"

try:
    from netem.core._core_header import NETWORK as NETWORK
    from netem.core._core_header import SOURCES
    from netem.core._core_header import ffi as ffi
except ImportError:
    raise CallerError(f"noack's core in C has not been built; {REMEDY}") from None


class CoreLibrary:
    """A library in C, with the declarations of its public headers.

    Args:
        path: the library; its name is the file's without ``lib`` and ``.so``.
        ffi: the declarations, included ones too.
        sources: digest of the sources of the declarations.

    Raises:
        CallerError: there is no library that goes with the declarations.
    """

    def __init__(self, path: Path, ffi: CData, sources: str) -> None:
        self.path, self.ffi, self.sources = path, ffi, sources
        self.functions = self.load(path)
        """The functions and constants of the headers."""

    def load(self, path: Path) -> CData:
        """Return the functions and constants of another file of this library."""
        try:
            library = self.ffi.dlopen(str(path))
            name = self.path.stem.removeprefix("lib")
            built_from = ffi.string(getattr(library, f"{name}_sources")()).decode()
        except (OSError, self.ffi.error) as error:
            reason = str(error).rpartition("': ")[2]  # begins with the path
            raise CallerError(f"noack's core in C cannot be loaded: {reason}; {REMEDY}") from None
        if built_from != self.sources:
            raise CallerError(f"{path}: was built from other sources than its declarations; {REMEDY}")
        return library

    def dtype_of(self, name: str) -> np.dtype[np.void]:
        """Return the row type of a structure of a public header that has numbers and their arrays only.

        >>> dtype_of("noack_window").names
        ('losses', 'packets')
        """
        return _dtype_of(self.ffi.typeof(name))

    def pointer_to(self, array: AnyArray, kind: str) -> CData:
        """Return a pointer to the rows of a contiguous array, e.g. of kind ``"noack_flow *"``.

        It is valid while the array lives.
        """
        if not array.flags.c_contiguous:
            raise ValueError("the core takes contiguous arrays")
        return self.ffi.cast(kind, ffi.from_buffer(array))  # faster than numpy's address

    def new_handle(self, kind: str, *arguments: object) -> CData:
        """Return a new ``noack_KIND *`` of the library, which is freed with the object returned.

        Args:
            kind: what it is, e.g. ``"link"``.
            arguments: for its function ``noack_KIND_new``.

        Raises:
            ValueError: the core refuses the arguments; the text says why.
            MemoryError: there is no memory.
        """
        wrong = ffi.new("const char **")
        handle = getattr(self.functions, f"noack_{kind}_new")(*arguments, wrong)
        require(handle != ffi.NULL, wrong, kind)
        return ffi.gc(handle, getattr(self.functions, f"noack_{kind}_free"))

    def new_structure(self, kind: str, numbers: Mapping[str, object] = MappingProxyType({})) -> CData:
        """Return a new structure of a header with these numbers, which functions of the core copy.

        >>> chance = new_structure("noack_chance", {"probability": 0.5})
        >>> chance.probability
        0.5
        """
        structure = self.ffi.new(f"{kind} *")
        set_fields(structure, numbers)
        return structure


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
def _dtype_of(kind: CData) -> np.dtype[np.void]:
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


def require(done: bool, wrong: CData, kind: str) -> None:
    """Raise ValueError with the text that the core has set, or MemoryError, unless a call was ``done``."""
    if not done:
        if wrong[0] == ffi.NULL:
            raise MemoryError
        raise ValueError(f"{kind}: {ffi.string(wrong[0]).decode()}")


def address_of(pointer: CData) -> int:
    """Return the address that a pointer of the core has."""
    return int(ffi.cast("intptr_t", pointer))


def set_fields(structure: CData, numbers: Mapping[str, object]) -> None:
    """Set fields of a structure that :meth:`CoreLibrary.new_structure` has made.

    An array becomes a pointer to a copy of it, which lives as long as the structure; None becomes
    NULL; the fields of a structure within it are a mapping.
    """
    arrays = _ARRAYS.setdefault(structure, [])
    _set_fields(structure, numbers, arrays)


def _set_fields(structure: CData, numbers: Mapping[str, object], arrays: list[AnyArray]) -> None:
    for name, number in numbers.items():
        if isinstance(number, Mapping):
            _set_fields(getattr(structure, name), number, arrays)
        elif isinstance(number, np.ndarray):
            whole = number.dtype.kind in "bi"
            array = np.array(number, np.int64 if whole else np.float64, order="C")
            arrays.append(array)
            setattr(structure, name, ffi.cast("int64_t *" if whole else "double *", ffi.from_buffer(array)))
        else:
            setattr(structure, name, ffi.NULL if number is None else number)


_ARRAYS: "WeakKeyDictionary[CData, list[AnyArray]]" = WeakKeyDictionary()
"""What structures point to."""


def reals_at(pointer: CData, *shape: int) -> Reals:
    """Return the numbers at a ``double *`` as an array, which shares their memory."""
    data = ffi.buffer(pointer, 8 * math.prod(shape))
    return np.frombuffer(data, np.float64).reshape(shape)


def rows_at(pointer: CData, count: int) -> StructRows:
    """Return the rows of a structure at a pointer as an array, which shares their memory."""
    kind = _dtype_of(ffi.typeof(pointer).item)
    return np.frombuffer(ffi.buffer(pointer, count * kind.itemsize), kind)


OWN = CoreLibrary(Path(__file__).with_name("libnetem.so"), ffi, SOURCES)
"""The network's library."""
core: CData = OWN.functions
"""The functions and constants of native/{shared,network,relay}/public.h."""
dtype_of, pointer_to = OWN.dtype_of, OWN.pointer_to
new_handle, new_structure = OWN.new_handle, OWN.new_structure


def require_live_runs() -> None:
    """Raise CallerError where there are no live runs: the core has its sockets on Linux only."""
    if not hasattr(core, "noack_relay_run"):
        raise CallerError(
            "live runs and the network emulator need Linux; `noack simulate` runs the same loop in "
            "virtual time"
        )
