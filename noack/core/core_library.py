"""The core in C (native/): its functions, and numpy's row types of its structures.

The library is built ahead of time, by ``make setup`` or with the wheel. Nothing is compiled here.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from noack.core.errors import CallerError

LIBRARY = Path(__file__).with_name("libnoack.so")
CData = Any
"""A structure or pointer of the core: mypy does not know its fields."""
Array = NDArray[np.generic]
"""Numbers, or rows of a structure of the core."""
Rows = NDArray[np.void]
"""Rows of a structure of the core."""
_REMEDY = "run `make setup` in the repository, or install noack again"

try:
    from noack.core._core_header import SOURCES as SOURCES
    from noack.core._core_header import ffi as ffi
except ImportError:
    raise CallerError(f"noack's core in C has not been built; {_REMEDY}") from None


def load_core(path: Path) -> CData:
    """Return the functions and constants of native/noack.h in a library.

    Raise CallerError if there is no library that goes with the declarations.
    """
    try:
        library = ffi.dlopen(str(path))
        built_from = ffi.string(library.noack_sources()).decode()
    except (OSError, ffi.error) as error:
        reason = str(error).rpartition("': ")[2]  # begins with the path
        raise CallerError(f"noack's core in C cannot be loaded: {reason}; {_REMEDY}") from None
    if built_from != SOURCES:
        raise CallerError(f"{path}: is not of the same sources as its declarations; {_REMEDY}")
    return library


core: CData = load_core(LIBRARY)
"""The functions and constants of native/noack.h."""

_FORMATS = {
    "int64_t": "<i8", "int32_t": "<i4", "uint8_t": "u1", "uint16_t": "<u2", "uint32_t": "<u4",
    "uint64_t": "<u8", "double": "<f8",
}  # fmt: skip


@cache
def dtype_of(name: str) -> np.dtype[np.void]:
    """Return the row type of a structure of native/noack.h that has numbers and their arrays only.

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


def pointer_to(array: Array, kind: str) -> CData:
    """Return a pointer to the rows of a contiguous array, e.g. of kind ``"noack_flow *"``.

    It is valid while the array lives.
    """
    if not array.flags.c_contiguous:
        raise ValueError("the core takes contiguous arrays")
    return ffi.cast(kind, array.ctypes.data)


def address_of(pointer: CData) -> int:
    """Return the address that a pointer of the core has."""
    return int(ffi.cast("intptr_t", pointer))
