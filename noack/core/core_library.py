"""The core in C (native/): its functions, and numpy's row types of its structures.

The library is built ahead of time, by ``make setup`` or with the wheel. Nothing is compiled here.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from noack.core.errors import CallerError

LIBRARY = Path(__file__).with_name("libnoack.so")
HEADER = LIBRARY.with_name("_core_header.py")

try:
    from noack.core._core_header import ffi as ffi
except ImportError:
    raise CallerError("noack's core has not been built; run `make setup` in its folder") from None

core: Any = ffi.dlopen(str(LIBRARY))
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


def _format_of(kind: Any) -> Any:
    if kind.kind == "array":
        return _format_of(kind.item), (kind.length,)
    return _FORMATS[kind.cname]


def pointer_to(array: NDArray[Any], kind: str) -> Any:
    """Return a pointer to the rows of a contiguous array, e.g. of kind ``"noack_flow *"``.

    It is valid while the array lives.
    """
    if not array.flags.c_contiguous:
        raise ValueError("the core takes contiguous arrays")
    return ffi.cast(kind, array.ctypes.data)


def address_of(pointer: Any) -> int:
    """Return the address that a pointer of the core has."""
    return int(ffi.cast("intptr_t", pointer))
