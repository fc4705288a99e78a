"""Coordinates in which a linear system contracts: ‖L e^{Gs} Y‖ ≤ ‖L Y‖ e^{−νs}.

−ν is the logarithmic norm of L G L^{−1}. Any invertible L with ν > 0 is suitable; LᵀL is then a
Lyapunov function. ν is computed from the final L, so rounding in the computation of L is harmless.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.core.lyapunov_equation import solve_lyapunov

Stack = NDArray[np.float64]
EPSILON = 8 * float(np.finfo(float).eps)
"""Times n and the product of the factors' magnitudes, this exceeds the rounding of a product."""


class Decay(NamedTuple):
    """A system's L and ν."""

    factor: Matrix
    """L, (n, n)."""
    inverse: Matrix
    """L^{−1}."""
    rate_per_s: float
    """ν > 0."""

    @property
    def stretch(self) -> float:
        """Upper bound of ‖e^{Gs}‖ for s ≥ 0."""
        return float(np.linalg.norm(self.factor, 2) * np.linalg.norm(self.inverse, 2))

    def bounds(self, C: Matrix, states: Stack) -> Stack:
        """Return bounds of ‖C e^{Gs} Y‖ over all s ≥ 0, for a stack of Y, (k, n, r) → (k,)."""
        return self.seen(C) * self.sizes(states)

    def seen(self, C: Matrix) -> float:
        """Return ‖C L^{−1}‖."""
        return float(np.linalg.norm(C @ self.inverse, 2))

    def sizes(self, states: Stack) -> Stack:
        """Return ‖L Y‖ for a stack of Y, (k, n, r) → (k,), in the Frobenius norm."""
        return frobenius_norms(product(self.factor, states))


def find_decay(generator: Matrix) -> Decay | None:
    """Return the better of two candidates for L; None if neither passes its check numerically."""
    return _find_decay(np.asarray(generator, dtype=np.float64).tobytes(), len(generator))


@lru_cache(maxsize=8)
def _find_decay(entries: bytes, n: int) -> Decay | None:
    generator = np.frombuffer(entries).reshape(n, n)
    rounding = EPSILON * len(generator) * float(np.linalg.norm(generator))
    if not spectral_abscissa(generator) < -rounding:
        return None
    candidates = (_lyapunov_factor(generator), _modal_factor(generator))
    checked = [_checked(generator, factor) for factor in candidates if factor is not None]
    decays = [decay for decay in checked if decay is not None]
    return min(decays, key=lambda decay: decay.stretch / decay.rate_per_s, default=None)


def _checked(generator: Matrix, factor: Matrix) -> Decay | None:
    """Return L with ν, reduced by a bound of the rounding error; None if ν is not positive."""
    try:
        inverse = np.asarray(np.linalg.inv(factor))
    except np.linalg.LinAlgError:
        return None
    turned = factor @ generator @ inverse
    # Rounding of the products, and the deviation of L times its computed inverse from identity.
    product = np.abs(factor) @ np.abs(generator) @ np.abs(inverse)
    identity = np.linalg.norm(np.abs(factor) @ np.abs(inverse)) * np.linalg.norm(turned)
    rounding = EPSILON * len(generator) * float(np.linalg.norm(product) + identity)
    if not math.isfinite(rounding):
        return None
    rate = -logarithmic_norm(turned) - rounding
    return Decay(factor, inverse, rate) if rate > 0 else None


def _lyapunov_factor(generator: Matrix) -> Matrix | None:
    """Return the factor of P, (G+νI)ᵀP + P(G+νI) = −I, ν half of G's decay rate; smooth in G."""
    n = len(generator)
    shifted = generator - 0.5 * spectral_abscissa(generator) * np.eye(n)
    try:
        P = solve_lyapunov(shifted.T, -np.eye(n))
        return np.asarray(np.linalg.cholesky(0.5 * (P + P.T)).T)
    except (np.linalg.LinAlgError, ValueError):
        return None


def _modal_factor(generator: Matrix) -> Matrix | None:
    """Return the inverse of G's real eigenvectors, the best L for modes of very different speed."""
    values, vectors = np.linalg.eig(generator)
    columns = np.where(values.imag < 0, vectors.imag, vectors.real)
    try:
        return np.asarray(np.linalg.inv(columns))
    except np.linalg.LinAlgError:
        return None


def logarithmic_norm(generator: Matrix) -> float:
    """μ with ‖e^{Gs}‖ ≤ e^{μs}, for the Euclidean norm."""
    return float(np.linalg.eigvalsh(0.5 * (generator + generator.T)).max())


def product(matrix: Matrix, stack: Stack) -> Stack:
    """Return M Y for a stack of Y, (k, n, r) → (k, q, r), by one product of M with all columns."""
    k, n, r = stack.shape
    columns = stack.transpose(1, 0, 2).reshape(n, k * r)
    return np.asarray((matrix @ columns).reshape(len(matrix), k, r).transpose(1, 0, 2))


def times(matrix: Matrix, values: Stack) -> Stack:
    """Return M Y for matrices Y along the last axis, (n, r, k) → (q, r, k)."""
    products = matrix @ values.reshape(len(values), -1)
    return np.asarray(products.reshape(len(matrix), *values.shape[1:]))


def frobenius_norms(stack: Stack) -> Stack:
    """Return the Frobenius norms of a stack of matrices, (k, q, r) → (k,)."""
    return np.asarray(np.sqrt(np.einsum("kij,kij->k", stack, stack)))


def spectral_norm(matrix: Matrix) -> float:
    """Return the spectral norm of a matrix."""
    return float(np.linalg.svd(matrix, compute_uv=False)[0])


def spectral_norms(stack: Stack) -> Stack:
    """Return the spectral norms of a stack of matrices, (k, q, r) → (k,)."""
    return largest_gains(np.ascontiguousarray(stack.transpose(1, 2, 0)))


def sizes(values: Stack) -> Stack:
    """Return the Frobenius norms of matrices along the last axis, (q, r, k) → (k,)."""
    return np.asarray(np.sqrt(np.einsum("ijk,ijk->k", values, values)))


def largest_gains(values: Stack) -> Stack:
    """Return the spectral norms of matrices along the last axis, (q, r, k) → (k,).

    They are roots of eigenvalues of Y Yᵀ, whose largest one has a small relative rounding error.
    """
    q, r, _ = values.shape
    if min(q, r) == 1:
        products = np.einsum("ijk,ijk->k", values, values)[None, None]
    else:
        products = np.einsum("ijk,ljk->ilk" if q < r else "jik,jlk->ilk", values, values)
    if not np.isfinite(products).all():  # the norm may be finite
        return np.asarray(np.linalg.norm(values, 2, axis=(0, 1)))
    return np.asarray(np.sqrt(np.maximum(_largest_eigenvalues(products), 0.0)))


def largest_eigenvalues(stack: Stack) -> Stack:
    """Return the largest eigenvalues of Gram matrices, (k, n, n) → (k,)."""
    return _largest_eigenvalues(stack.transpose(1, 2, 0))


def _largest_eigenvalues(products: Stack) -> Stack:
    """Return the largest eigenvalues of Gram matrices along the last axis, (n, n, k) → (k,)."""
    n = len(products)
    if n == 1:
        return np.asarray(products[0, 0])
    if n == 2:
        (a, b), (_, d) = products
        return np.asarray(0.5 * (a + d) + np.hypot(0.5 * (a - d), b))
    if n > 3:
        return np.asarray(np.linalg.eigvalsh(products.transpose(2, 0, 1))[:, -1])
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
