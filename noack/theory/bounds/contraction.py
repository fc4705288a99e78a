"""Coordinates in which a linear system contracts: ‖L e^{Gs} Y‖ ≤ ‖L Y‖ e^{−νs}.

−ν is the logarithmic norm of L G L^{−1}. Any invertible L with ν > 0 is suitable; LᵀL is then a
Lyapunov function. ν is computed from the final L, so rounding in the computation of L is harmless.
"""

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_function
from noack.core.linear_systems import Matrix, solve_lyapunov

Stack = NDArray[np.float64]
EPSILON = 8 * float(np.finfo(float).eps)
"""Times n and the product of the factors' magnitudes, this exceeds the rounding of a product."""


class Decay(NamedTuple):
    """L and ν of a system, or of each of a stack of systems."""

    factor: Matrix
    """L, (…, n, n)."""
    inverse: Matrix
    """L^{−1}."""
    rate_per_s: Stack
    """ν, (…); not above 0 where no L was found."""

    @property
    def stretch(self) -> Stack:
        """Upper bound of ‖e^{Gs}‖ for s ≥ 0, (…)."""
        return spectral_norm(self.factor) * spectral_norm(self.inverse)

    @property
    def area_s(self) -> Stack:
        """Upper bound of ∫‖e^{Gs}‖ds over all times, (…); infinite where no L was found."""
        decays = self.rate_per_s > 0
        return np.where(decays, self.stretch / np.where(decays, self.rate_per_s, 1.0), np.inf)

    def bounds(self, C: Matrix, states: Stack) -> Stack:
        """Return bounds of ‖C e^{Gs} Y‖ over all s ≥ 0, for stacks of Y, (…, k, n, r) → (…, k)."""
        return spectral_norm(C @ self.inverse)[..., None] * self.sizes(states)

    def sizes(self, states: Stack) -> Stack:
        """Return ‖L Y‖ for stacks of Y, (…, k, n, r) → (…, k), in the Frobenius norm."""
        return frobenius_norms(product(self.factor, states))


@cached_function(8)
def find_decay(generator: Matrix) -> Decay | None:
    """Return the better of two candidates for L, of each of a stack of generators, (…, n, n).

    A candidate must pass its check numerically. None: no L was found for any of them.
    """
    rounding = EPSILON * generator.shape[-1] * np.linalg.norm(generator, axis=(-2, -1))
    slowest = abscissas(generator)
    candidates = (_lyapunov_factors(generator, slowest), _modal_factors(generator))
    by_first, by_second = (_checked(generator, factor, slowest < -rounding) for factor in candidates)
    better = by_second.area_s < by_first.area_s
    rates = np.where(better, by_second.rate_per_s, by_first.rate_per_s)
    if not (rates > 0).any():
        return None
    is_second = better[..., None, None]
    factor = np.where(is_second, by_second.factor, by_first.factor)
    return Decay(factor, np.where(is_second, by_second.inverse, by_first.inverse), rates)


def _checked(generator: Matrix, factor: Matrix, may_decay: NDArray[np.bool_]) -> Decay:
    """Return L with ν, reduced by a bound of the rounding error; ν = 0 if L is not suitable."""
    inverse = _each(np.linalg.inv, factor)
    turned = factor @ generator @ inverse
    # Rounding of the products, and the deviation of L times its computed inverse from identity.
    product = np.abs(factor) @ np.abs(generator) @ np.abs(inverse)
    identity = np.linalg.norm(np.abs(factor) @ np.abs(inverse), axis=(-2, -1))
    identity = identity * np.linalg.norm(turned, axis=(-2, -1))
    size = np.linalg.norm(product, axis=(-2, -1)) + identity
    rounding = EPSILON * generator.shape[-1] * size
    usable = may_decay & np.isfinite(rounding)
    eye = np.eye(generator.shape[-1])
    factor, inverse, turned = (
        np.where(usable[..., None, None], matrix, eye) for matrix in (factor, inverse, turned)
    )
    rates = np.where(usable, -logarithmic_norm(turned) - rounding, 0.0)
    return Decay(factor, inverse, rates)


def _lyapunov_factors(generator: Matrix, slowest: Stack) -> Matrix:
    """Return the factor of P, (G+νI)ᵀP + P(G+νI) = −I, ν half of G's decay rate; smooth in G.

    NaN where there is none.
    """
    eye = np.eye(generator.shape[-1])
    shifted = generator - 0.5 * slowest[..., None, None] * eye
    P = _each(lambda M: solve_lyapunov(M.swapaxes(-1, -2), -eye), shifted)
    return np.asarray(_each(np.linalg.cholesky, 0.5 * (P + P.swapaxes(-1, -2))).swapaxes(-1, -2))


def _modal_factors(generator: Matrix) -> Matrix:
    """Return the inverse of G's real eigenvectors, the best L for modes of very different speed."""
    values, vectors = np.linalg.eig(generator)
    columns = np.where(values.imag[..., None, :] < 0, vectors.imag, vectors.real)
    return _each(np.linalg.inv, columns)


def _each(function: Callable[..., Any], stack: Matrix) -> Matrix:
    """Return a function of each matrix of a stack; NaN where it fails."""
    if np.isfinite(stack).all():
        with contextlib.suppress(np.linalg.LinAlgError):
            return np.asarray(function(stack))
    inverses = np.full(stack.shape, np.nan)
    for index in np.ndindex(stack.shape[:-2]):
        with contextlib.suppress(np.linalg.LinAlgError, ValueError):
            inverses[index] = function(stack[index])
    return inverses


def abscissas(generator: Matrix) -> Stack:
    """Return the largest real part of the eigenvalues of each matrix, (…, n, n) → (…)."""
    return np.asarray(np.linalg.eigvals(generator).real.max(axis=-1))


def logarithmic_norm(generator: Matrix) -> Stack:
    """Return μ of each matrix, (…, n, n) → (…): ‖e^{Gs}‖ ≤ e^{μs}, for the Euclidean norm."""
    symmetric = 0.5 * (generator + generator.swapaxes(-1, -2))
    return np.asarray(np.linalg.eigvalsh(symmetric).max(axis=-1))


def product(matrix: Matrix, stack: Stack) -> Stack:
    """Return M Y for stacks of Y, (…, k, n, r) → (…, k, q, r), by one product with all columns."""
    *lead, k, n, r = stack.shape
    columns = stack.swapaxes(-3, -2).reshape(*lead, n, k * r)
    products = matrix @ columns
    return np.asarray(products.reshape(*products.shape[:-1], k, r).swapaxes(-3, -2))


def times(matrix: Matrix, values: Stack) -> Stack:
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
    return largest_gains(np.ascontiguousarray(stack.transpose(1, 2, 0)))


def sizes(values: Stack) -> Stack:
    """Return the Frobenius norms of matrices along the last axis, (…, q, r, k) → (…, k)."""
    return np.asarray(np.sqrt(np.einsum("...ijk,...ijk->...k", values, values)))


def largest_gains(values: Stack) -> Stack:
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
    return np.asarray(np.sqrt(np.maximum(_largest_eigenvalues(products), 0.0)))


def largest_eigenvalues(stack: Stack) -> Stack:
    """Return the largest eigenvalues of Gram matrices, (k, n, n) → (k,)."""
    return _largest_eigenvalues(np.moveaxis(stack, 0, -1))


def _largest_eigenvalues(products: Stack) -> Stack:
    """Return the largest eigenvalues of Gram matrices, (n, n, …, k) → (…, k)."""
    n = len(products)
    if n == 1:
        return np.asarray(products[0, 0])
    if n == 2:
        (a, b), (_, d) = products
        return np.asarray(0.5 * (a + d) + np.hypot(0.5 * (a - d), b))
    if n > 3:
        return np.asarray(np.linalg.eigvalsh(np.moveaxis(products, (0, 1), (-2, -1)))[..., -1])
    # The largest root of the characteristic polynomial, of the matrix with the trace 3.
    (a, b, c), (_, d, e), (_, _, f) = products
    scale = (a + d + f) / 3
    a, b, c, d, e, f = np.array([a, b, c, d, e, f]) / np.where(scale > 0, scale, 1.0)
    a, d, f = a - 1, d - 1, f - 1
    spread = np.sqrt((a * a + d * d + f * f + 2 * (b * b + c * c + e * e)) / 6)
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    cosine = 0.5 * determinant / np.where(spread > 0, spread, 1.0) ** 3
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)) / 3
    return np.asarray(scale * (1 + 2 * spread * np.cos(angle)))
