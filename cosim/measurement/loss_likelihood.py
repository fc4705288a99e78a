"""The likelihood of loss bursts under a two-state Markov chain with hidden states.

The chain is that of :mod:`noack.impairments.loss_models.gilbert_elliott`, here stationary from the
first packet on. With P its transition matrix, D₁ = P diag(loss probabilities) and D₀ = P − D₁, the
likelihood of a trace is π D₀^a₁ D₁^b₁ D₀^a₂ … 1, where a and b are the numbers of consecutive
deliveries and losses. The product is reduced pair by pair, so that it takes a time proportional to
the number of bursts. A burst that is left out separates two independent traces: its matrix is 1 π.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.measurement.loss_bursts import Flags, LossBursts

Reals = NDArray[np.float64]


class ChainRates(NamedTuple):
    """The probabilities of a Gilbert–Elliott chain, per packet."""

    good_to_bad: float
    bad_to_good: float
    loss_in_good: float
    loss_in_bad: float

    @property
    def share_bad(self) -> float:
        """Share of packets in the bad state."""
        return self.good_to_bad / (self.good_to_bad + self.bad_to_good)

    @property
    def loss_rate(self) -> float:
        """Share of packets that are lost in the long run."""
        bad = self.share_bad
        return (1 - bad) * self.loss_in_good + bad * self.loss_in_bad

    def matrices(self) -> tuple[Reals, Reals, Reals]:
        """Return π, (2,), D₀ and D₁, (2, 2)."""
        p, r = self.good_to_bad, self.bad_to_good
        moves = np.array([[1 - p, p], [r, 1 - r]])
        lost = np.array([self.loss_in_good, self.loss_in_bad])
        start = np.array([1 - self.share_bad, self.share_bad])
        return start, moves * (1 - lost), moves * lost

    def survival(self, *, lost: bool) -> Callable[[Reals], Reals]:
        """Return ℓ → P(length ≥ ℓ) of loss bursts, or of the deliveries between them."""
        start, delivers, loses = self.matrices()
        before, during = (delivers, loses) if lost else (loses, delivers)
        first = start @ before @ during
        total = first.sum()

        def at_least(length: Reals) -> Reals:
            log_scale, power = _powers(during, np.asarray(length, float) - 1)
            with np.errstate(under="ignore"):
                return np.asarray(np.exp(log_scale) * (first @ power).sum(axis=-1) / total)

        return at_least


def _powers(matrix: Reals, exponents: Reals) -> tuple[Reals, Reals]:
    """Return log λ^n, (k,), and (matrix/λ)^n, (k, 2, 2), with λ the largest eigenvalue."""
    (a, b), (c, d) = matrix
    root = np.sqrt((a - d) ** 2 + 4 * b * c)
    high = (a + d + root) / 2
    if high <= 0:
        return np.where(exponents > 0, -np.inf, 0.0), np.tile(np.eye(2), (len(exponents), 1, 1))
    if root < 1e-300:
        return exponents * np.log(high), np.tile(np.eye(2), (len(exponents), 1, 1))
    low = (a * d - b * c) / high
    projector = (matrix - low * np.eye(2)) / root
    ratio = np.power(low / high, exponents)
    return exponents * np.log(high), projector + ratio[:, None, None] * (np.eye(2) - projector)


class LossLikelihood:
    """Log-likelihood of a trace's bursts as a function of the chain's probabilities."""

    def __init__(self, bursts: LossBursts, left_out: Flags | None = None) -> None:
        self._losses, self._loss_of = np.unique(bursts.length, return_inverse=True)
        self._deliveries, self._delivery_of = np.unique(bursts.deliveries(), return_inverse=True)
        self._left_out = None if left_out is None or not left_out.any() else left_out

    def __call__(self, rates: ChainRates) -> float:
        """Return the logarithm of the likelihood; −∞ if the trace is impossible."""
        start, delivers, loses = rates.matrices()
        log_d, d = _powers(delivers, self._deliveries.astype(float))
        log_l, l = _powers(loses, self._losses.astype(float))  # noqa: E741
        log_loss, loss = log_l[self._loss_of], l[self._loss_of]
        if self._left_out is not None:
            log_loss = np.where(self._left_out, 0.0, log_loss)
            loss[self._left_out] = np.ones((2, 1)) * start
        factors = _products(d[self._delivery_of[:-1]], loss)
        total = float(log_d[self._delivery_of].sum() + log_loss.sum())
        with np.errstate(divide="ignore", invalid="ignore"):
            while len(factors) > 1:
                odd = factors[len(factors) - len(factors) % 2 :]
                factors = _products(factors[0 : len(factors) - len(odd) : 2], factors[1::2])
                scale = factors.max(axis=(1, 2))
                total += float(np.log(scale).sum())
                factors = np.concatenate([factors / scale[:, None, None], odd])
            row = start if not len(factors) else start @ factors[0]
            total += float(np.log((row @ d[self._delivery_of[-1]]).sum()))
        return total if np.isfinite(total) else -np.inf


def _products(left: Reals, right: Reals) -> Reals:
    """Return the products of pairs of 2×2 matrices, (k, 2, 2)."""
    return np.asarray(left[:, :, :1] * right[:, :1, :] + left[:, :, 1:] * right[:, 1:, :])
