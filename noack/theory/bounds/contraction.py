"""Coordinates in which a linear system contracts: ‖L e^{Gs} Y‖ ≤ ‖L Y‖ e^{−νs}.

−ν is the logarithmic norm (Dahlquist, 1958) of L G L^{−1}. Any invertible L with ν > 0 is suitable;
LᵀL is then a Lyapunov function. ν is computed from the final L, so rounding in the computation of L
is harmless.
"""

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from noack.core.cached_method import cached_function
from noack.core.linear_systems import Matrix, solve_lyapunov
from noack.theory.bounds.stacked_norms import Stack, frobenius_norms, spectral_norm, stack_product

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
        return frobenius_norms(stack_product(self.factor, states))


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
    transformed = factor @ generator @ inverse
    # Rounding of the products, and the deviation of L times its computed inverse from identity.
    product = np.abs(factor) @ np.abs(generator) @ np.abs(inverse)
    identity = np.linalg.norm(np.abs(factor) @ np.abs(inverse), axis=(-2, -1))
    identity = identity * np.linalg.norm(transformed, axis=(-2, -1))
    size = np.linalg.norm(product, axis=(-2, -1)) + identity
    rounding = EPSILON * generator.shape[-1] * size
    usable = may_decay & np.isfinite(rounding)
    eye = np.eye(generator.shape[-1])
    factor, inverse, transformed = (
        np.where(usable[..., None, None], matrix, eye) for matrix in (factor, inverse, transformed)
    )
    rates = np.where(usable, -logarithmic_norm(transformed) - rounding, 0.0)
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
