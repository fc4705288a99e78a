"""Products and norms of many matrices at once, and their larger values over cells of time.

A stack has the indices of its matrices first, (…, k, n, r). Functions that end in ``_along_last`` take
matrices along the last axis, (…, n, r, k), where long stacks of small matrices are faster.
"""

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix

Stack = NDArray[np.float64]
ROUNDING = 1 + 1e-9
"""A computed norm, times this, is not below the exact one: estimated, not proven (docs/theory.md, "Why the
suprema are enclosed, not sampled")."""
_COSINE_ERROR = 16 * np.finfo(np.float64).eps
"""Rounding error of the cosine in the closed form of a largest eigenvalue, times 1 + 1/spread."""


def stack_product(matrix: Matrix, stack: Stack) -> Stack:
    """Return M Y for stacks of Y, (…, k, n, r) → (…, k, q, r), by one product with all columns."""
    *lead, k, n, r = stack.shape
    columns = stack.swapaxes(-3, -2).reshape(*lead, n, k * r)
    products = matrix @ columns
    return np.asarray(products.reshape(*products.shape[:-1], k, r).swapaxes(-3, -2))


def product_along_last(matrix: Matrix, values: Stack) -> Stack:
    """Return M Y for matrices Y along the last axis, (…, n, r, k) → (…, q, r, k)."""
    *lead, r, k = values.shape
    products = matrix @ values.reshape(*lead, r * k)
    return np.asarray(products.reshape(*products.shape[:-1], r, k))


def frobenius_norms(stack: Stack) -> Stack:
    """Return the Frobenius norms of stacks of matrices, (…, q, r) → (…)."""
    return np.asarray(np.sqrt(np.einsum("...ij,...ij->...", stack, stack)))


def spectral_norm(matrix: Matrix) -> Stack:
    """Return the spectral norms of matrices, (…, q, r) → (…)."""
    return np.asarray(np.linalg.svd(matrix, compute_uv=False)[..., 0])


def spectral_norms(stack: Stack) -> Stack:
    """Return the spectral norms of a long stack of matrices, (k, q, r) → (k,)."""
    return spectral_norms_along_last(np.ascontiguousarray(stack.transpose(1, 2, 0)))


def frobenius_norms_along_last(values: Stack) -> Stack:
    """Return the Frobenius norms of matrices along the last axis, (…, q, r, k) → (…, k)."""
    return np.asarray(np.sqrt(np.einsum("...ijk,...ijk->...k", values, values)))


def spectral_norms_along_last(values: Stack) -> Stack:
    """Return the spectral norms of matrices along the last axis, (…, q, r, k) → (…, k).

    They are roots of eigenvalues of Y Yᵀ, whose largest one has a small relative rounding error.
    """
    q, r = values.shape[-3:-1]
    if min(q, r) == 1:
        products = np.einsum("...ijk,...ijk->...k", values, values)[None, None]
    else:
        pairs = "...ijk,...ljk->il...k" if q < r else "...jik,...jlk->il...k"
        products = np.einsum(pairs, values, values)
    if not np.isfinite(products).all():  # the norm may be finite
        return np.asarray(np.linalg.norm(values, 2, axis=(-3, -2)))
    return np.asarray(np.sqrt(np.maximum(_largest_eigenvalues_along_last(products), 0.0)))


def largest_eigenvalues(stack: Stack) -> Stack:
    """Return the largest eigenvalues of Gram matrices, (k, n, n) → (k,)."""
    return _largest_eigenvalues_along_last(np.moveaxis(stack, 0, -1))


def _largest_eigenvalues_along_last(products: Stack) -> Stack:
    """Return the largest eigenvalues of Gram matrices, (n, n, …, k) → (…, k)."""
    n = len(products)
    if n == 1:
        return np.asarray(products[0, 0])
    if n == 2:
        (a, b), (_, d) = products
        return np.asarray(0.5 * (a + d) + np.hypot(0.5 * (a - d), b))
    if n > 3:
        return np.asarray(np.linalg.eigvalsh(np.moveaxis(products, (0, 1), (-2, -1)))[..., -1])
    # The largest root of the characteristic polynomial, of the matrix with the trace 3 (Smith,
    # Communications of the ACM 4, 1961).
    (a, b, c), (_, d, e), (_, _, f) = products
    scale = (a + d + f) / 3
    a, b, c, d, e, f = np.array([a, b, c, d, e, f]) / np.where(scale > 0, scale, 1.0)
    a, d, f = a - 1, d - 1, f - 1
    spread = np.sqrt((a * a + d * d + f * f + 2 * (b * b + c * c + e * e)) / 6)
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    divisor = np.where(spread > 0, spread, 1.0)
    # With its rounding error added: near a double root (−1) the angle has the root of this error, and
    # must not be too large.
    cosine = 0.5 * determinant / divisor**3 + _COSINE_ERROR * (1 + 1 / divisor)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)) / 3
    return np.asarray(scale * (1 + 2 * spread * np.cos(angle)))


def larger_ends(values: Stack) -> Stack:
    """Return for each cell the larger of its values at both ends, (…, k + 1) → (…, k)."""
    return np.asarray(np.maximum(values[..., :-1], values[..., 1:]))
