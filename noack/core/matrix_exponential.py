"""The exponential of a small matrix, with the same bits on every processor.

A library's depends on the processor, by the BLAS below it. Two hosts of one run, or a run and its
replay on another machine, would then differ in the last bits of every state. The method is in
native/loop/exponential.c.
"""

import numpy as np
from numpy.typing import NDArray

from noack.core.core_library import core, pointer_to

SCRATCH_MATRICES = 10
"""Matrices of its size that the core needs for scratch."""


def exponential(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return e^M, (n, n). An entry that overflows is infinite or not a number."""
    given = np.ascontiguousarray(matrix, np.float64)
    result, scratch = np.empty_like(given), np.empty((SCRATCH_MATRICES, *given.shape))
    if len(given):
        pointers = (pointer_to(array, "double *") for array in (given, result, scratch))
        core.noack_exponential(len(given), *pointers)
    return result
