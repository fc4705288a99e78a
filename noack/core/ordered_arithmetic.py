"""Products and norms with a fixed order of operations.

A sum is formed from the left, and each product is rounded before it is added. The same inputs
then give the same bits in Python, in compiled code and on every processor. With a BLAS the last
bits of a product depend on the processor and on the memory layout.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SMALL = 25
"""A product with a matrix of at most this size takes less time without numpy."""
_LEAST, _MOST = 1e-280, 1e280
"""A sum of squares between these limits has neither underflowed nor overflowed."""


def product(matrix: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix, shape (p, n), times the vector, shape (n,)."""
    if matrix.size > _SMALL:
        with np.errstate(over="ignore", invalid="ignore"):  # a run may diverge
            sums: NDArray[np.float64] = np.add.accumulate(matrix * vector, axis=1)[:, -1].copy()
        return sums
    values, found = vector.tolist(), []
    for row in matrix.tolist():
        total = -0.0
        for entry, value in zip(row, values, strict=True):
            total += entry * value
        found.append(total)
    return np.array(found)


def norm_of(values: Sequence[float], begin: int, count: int) -> float:
    """Return the Euclidean norm of ``count`` values without overflow of squares."""
    total = 0.0
    for k in range(begin, begin + count):
        total += values[k] * values[k]
    if _LEAST < total < _MOST:
        return math.sqrt(total)
    largest = 0.0
    for k in range(begin, begin + count):
        size = abs(values[k])
        if size > largest:
            largest = size
    if largest == math.inf:
        return largest
    if largest == 0.0:
        return total  # 0, or not a number
    total = 0.0
    for k in range(begin, begin + count):
        scaled = values[k] / largest
        total += scaled * scaled
    return largest * math.sqrt(total)


def multiply(
    matrix: Any, begin: int, vector: Any, first: int, result: Any, into: int, shape: Any
) -> None:
    """Do what :func:`product` does with flat arrays, which are given with their first places.

    ``shape`` is (p, n). The result must not overlap the vector.
    """
    rows, columns = shape
    for i in range(rows):
        total = -0.0
        for k in range(columns):
            total += matrix[begin + i * columns + k] * vector[first + k]
        result[into + i] = total
