"""The loop's library in C (native/): its functions and handles. See :mod:`netem.core.core_library`.

Its declarations include the network's types, not the network's functions. A handle of the network, such as a
link, is made by the network's library, and may be given to functions of this library: it has a copy of the
network's code, from the same sources.
"""

from pathlib import Path

from netem.core.core_library import NETWORK as OTHER_NETWORK
from netem.core.core_library import REMEDY, CData, CoreLibrary
from netem.core.errors import CallerError

try:
    from noack.core._core_header import NETWORK, SOURCES
    from noack.core._core_header import ffi as ffi
except ImportError:
    raise CallerError(f"noack's core in C has not been built; {REMEDY}") from None
if NETWORK != OTHER_NETWORK:
    raise CallerError(f"noack and noack-netem are of two versions; {REMEDY}")

SCRATCH_MATRICES = 10
"""Matrices of a matrix's size that the core needs for scratch, for its exponential."""

OWN = CoreLibrary(Path(__file__).with_name("libnoack.so"), ffi, SOURCES)
"""The loop's library."""
core: CData = OWN.functions
"""The functions of native/{loop,driver,exact}/public.h, and their constants."""
dtype_of, pointer_to = OWN.dtype_of, OWN.pointer_to
new_handle, new_structure = OWN.new_handle, OWN.new_structure
