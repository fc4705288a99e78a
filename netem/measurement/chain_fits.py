"""Fits of loss models to bursts: independent losses, Gilbert's chain, Gilbert–Elliott's chain.

First comes the likelihood of a chain. It is that of
:mod:`netem.impairments.loss_models.gilbert_elliott`, here stationary from the first packet on. With
P its transition matrix, D₁ = P diag(loss probabilities) and D₀ = P − D₁, the likelihood of a trace
is π D₀^a₁ D₁^b₁ D₀^a₂ … 1, where a and b are the numbers of consecutive deliveries and losses. The
product is reduced pair by pair, so that it takes a time proportional to the number of bursts. A
burst that is left out separates two independent traces: its matrix is 1 π.

Then come the tests of a fit, and the fits. Gilbert's chain loses all packets in the bad state and
none in the good one: its states are visible, and the fit is in closed form. Those of
Gilbert–Elliott's are hidden, and its likelihood is maximised numerically. The intervals are
profile-likelihood intervals.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import expit, logit, xlogy

from netem.measurement.interval_estimates import (
    IntervalEstimate,
    Minimum,
    binomial_estimate,
    minimise,
    profile_interval,
)
from netem.measurement.loss_bursts import Flags, LossBursts

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
        transitions = np.array([[1 - p, p], [r, 1 - r]])
        lost = np.array([self.loss_in_good, self.loss_in_bad])
        start = np.array([1 - self.share_bad, self.share_bad])
        return start, transitions * (1 - lost), transitions * lost

    def survival(self, *, lost: bool) -> Callable[[Reals], Reals]:
        """Return ℓ → P(length ≥ ℓ) of loss bursts, or of the deliveries between them."""
        start, delivers, loses = self.matrices()
        before, during = (delivers, loses) if lost else (loses, delivers)
        entry = start @ before @ during
        total = entry.sum()

        def at_least(length: Reals) -> Reals:
            log_scale, power = _powers(during[..., None], np.asarray(length, float) - 1)
            with np.errstate(under="ignore"):
                sums = np.einsum("a,abk->k", entry, power[:, :, 0])
                return np.asarray(np.exp(log_scale[0]) * sums / total)

        return at_least


def _powers(matrices: Reals, exponents: Reals) -> tuple[Reals, Reals]:
    """Return log λ^n, (j, k), and (matrix/λ)^n, (2, 2, j, k), with λ the largest eigenvalue.

    ``matrices`` is (2, 2, j), ``exponents`` is (k,).
    """
    (a, b), (c, d) = matrices[..., None]
    root = np.sqrt((a - d) ** 2 + 4 * b * c)
    high = (a + d + root) / 2
    identity = np.eye(2)[:, :, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithms = np.where(high > 0, exponents * np.log(high), np.where(exponents > 0, -np.inf, 0.0))
        low = (a * d - b * c) / high
        projector = (matrices[..., None] - low * identity) / root
        powers = projector + np.power(low / high, exponents) * (identity - projector)
    is_multiple = (high <= 0) | (root < 1e-300)  # of the identity
    return logarithms, np.where(is_multiple, identity, powers)


class LossLikelihood:
    """Log-likelihood of a trace's bursts as a function of the chain's probabilities."""

    def __init__(self, bursts: LossBursts, left_out: Flags | None = None) -> None:
        self._losses, self._loss_of = np.unique(bursts.length, return_inverse=True)
        self._deliveries, self._delivery_of = np.unique(bursts.deliveries(), return_inverse=True)
        self._left_out = None if left_out is None or not left_out.any() else left_out

    def __call__(self, rates: ChainRates) -> float:
        """Return the logarithm of the likelihood; −∞ if the trace is impossible."""
        return float(self.of_chains(np.array([rates]))[0])

    def of_chains(self, rates: Reals) -> Reals:
        """Return those of several chains, (j,), whose probabilities are the rows of (j, 4)."""
        to_bad, to_good, *losses = rates.T
        lost = np.array(losses)
        transitions = np.array([[1 - to_bad, to_bad], [to_good, 1 - to_good]])
        start = np.array([to_good, to_bad]) / (to_bad + to_good)
        # A factor for each stretch of deliveries and the burst after it, apart from its scale.
        log_delivering, delivering = _powers(transitions * (1 - lost), self._deliveries.astype(float))
        log_losing, losing = _powers(transitions * lost, self._losses.astype(float))
        log_loss, loss = log_losing[:, self._loss_of], losing[..., self._loss_of]
        if self._left_out is not None:
            log_loss = np.where(self._left_out, 0.0, log_loss)
            loss = np.where(self._left_out, start[None, :, :, None], loss)
        factors = _products(delivering[..., self._delivery_of[:-1]], loss)
        total = log_delivering[:, self._delivery_of].sum(axis=1) + log_loss.sum(axis=1)
        # Their product, by pairs: it would underflow, so each round is scaled.
        with np.errstate(divide="ignore", invalid="ignore"):
            while (count := factors.shape[-1]) > 1:
                odd = factors[..., count - count % 2 :]
                factors = _products(factors[..., 0 : count - count % 2 : 2], factors[..., 1::2])
                scale = factors.max(axis=(0, 1))
                total += np.log(scale).sum(axis=1)
                factors = np.concatenate([factors / scale, odd], axis=-1)
            row = start if not count else (start[:, None] * factors[..., 0]).sum(axis=0)
            total += np.log((row[:, None] * delivering[..., self._delivery_of[-1]]).sum(axis=(0, 1)))
        return np.where(np.isfinite(total), total, -np.inf)


def _products(left: Reals, right: Reals) -> Reals:
    """Return the products of pairs of 2×2 matrices, (2, 2, j, k)."""
    return np.asarray(left[:, :1] * right[:1] + left[:, 1:] * right[1:])


SIGNIFICANCE = 0.01
"""Level at which a model is called rejected."""
FEWEST_EXPECTED = 5.0
"""Smallest expected count of a class; smaller ones are merged."""


@dataclass(frozen=True)
class FitTest:
    """The result of a test."""

    statistic: float | None
    degrees: int
    p_value: float | None
    """None: too few data for the test."""
    name: str = "lengths"
    """What is tested: the ``lengths`` of bursts and deliveries, or whether losses are in ``bursts``."""
    tests: int = 1
    """Of how many tests this is the one with the smallest p, which is multiplied by their number."""

    @property
    def verdict(self) -> str:
        """In a word."""
        if self.p_value is None:
            return "too few bursts to test"
        return "rejected" if self.p_value < SIGNIFICANCE else "not rejected"

    @property
    def numbers_text(self) -> str:
        """Name, statistic, degrees of freedom, and p."""
        if self.p_value is None:
            return ""
        of_tests = f" (of {self.tests} tests)" if self.tests > 1 else ""
        return (
            f"{self.name}: χ² = {self.statistic:.4g}, {self.degrees} d.f., p = {self.p_value:.2g}{of_tests}"
        )


def length_test(bursts: LossBursts, left_out: Flags, rates: ChainRates, parameters: int) -> FitTest:
    """Test whether the lengths of bursts and deliveries follow a model with fitted parameters.

    Lengths that the trace, or a burst that is left out, cuts are not counted. The classes are
    chosen from the expected counts alone.
    """
    deliveries = bursts.deliveries()[1:-1][~left_out[1:] & ~left_out[:-1]]
    lengths = ((bursts.length[bursts.complete & ~left_out], True), (deliveries, False))
    statistic, degrees = 0.0, -parameters
    for observed, lost in lengths:
        chi_squared, classes = _pearson(observed, rates, lost=lost)
        statistic, degrees = statistic + chi_squared, degrees + classes - 1
    if degrees < 1:
        return FitTest(None, max(degrees, 0), None)
    return FitTest(statistic, degrees, float(stats.chi2.sf(statistic, degrees)))


def _pearson(observed: NDArray[np.int64], rates: ChainRates, *, lost: bool) -> tuple[float, int]:
    """Return χ² and the number of classes, of the lengths of loss bursts or of deliveries."""
    count = len(observed)
    edges = _edges(rates.survival(lost=lost), count)
    tails = np.append(rates.survival(lost=lost)(edges.astype(float)), 0.0)
    expected = -np.diff(tails) * count
    counts = np.histogram(observed, np.append(edges, np.iinfo(np.int64).max))[0]
    return float(((counts - expected) ** 2 / np.maximum(expected, 1e-300)).sum()), len(edges)


def _edges(survival: Callable[[Reals], Reals], count: int) -> NDArray[np.int64]:
    """Return the smallest length of each class: each class expects enough lengths."""
    longest = 1
    while count * survival(np.array([longest]))[0] >= FEWEST_EXPECTED and longest < 2**40:
        longest *= 2
    # Lengths that are worth an edge: all short ones, then ever coarser ones.
    grid = np.unique(np.geomspace(1, longest, 400).round().astype(np.int64))
    tails = count * survival(grid.astype(float))
    edges, share = [1], max(FEWEST_EXPECTED, count / 20)
    for length, tail in zip(grid.tolist()[1:], tails.tolist()[1:], strict=True):
        expected = count * survival(np.array([edges[-1]]))[0]
        if expected - tail >= share and tail >= FEWEST_EXPECTED:
            edges.append(length)
    return np.array(edges)


ModelName = Literal["bernoulli", "gilbert", "gilbert_elliott"]
MOST_FITTED = 5_000
"""Number of bursts that a fit uses, at most: their intervals are within some percent."""
_LIMIT = 18.0
"""Largest log-odds: a probability within 1.5e-8 of 0 or 1 counts as 0 or 1."""
_STARTS = ((0.02, 0.5), (0.2, 0.8), (0.0, 0.5), (0.0, 0.95), (0.05, 0.999))
"""Loss probabilities of the two states, from which the search starts."""
_SEARCHES = 5
"""Starting points, the likeliest ones, from which the likelihood is maximised."""


@dataclass(frozen=True)
class ChainFit:
    """A loss model with its estimates; those that it fixes are missing."""

    model: ModelName
    rates: ChainRates
    estimates: dict[str, IntervalEstimate | None]
    """By parameter; None: the data do not determine it."""
    log_likelihood: float
    parameters: int


class Transitions(NamedTuple):
    """How often Gilbert's chain changed its state, out of how often it could have."""

    to_bad: int
    from_good: int
    to_good: int
    from_bad: int


def transitions(bursts: LossBursts, left_out: Flags) -> Transitions:
    """Count the transitions; packets beside a burst that is left out have no neighbour there."""
    kept = ~left_out
    follows, ends = bursts.first > 0, bursts.end < bursts.packets
    deliveries, losses = int(bursts.deliveries().sum()), int(bursts.length[kept].sum())
    delivered_last = not len(bursts.first) or bool(ends[-1])
    return Transitions(
        int((kept & follows).sum()),
        deliveries - int((left_out & follows).sum()) - int(delivered_last),
        int((kept & ends).sum()),
        losses - int((kept & ~ends).sum()),
    )


class ChainFits:
    """The three fits to the bursts of a trace that are not left out.

    Of more than ``MOST_FITTED`` bursts, the first ones are used.
    """

    def __init__(self, bursts: LossBursts, left_out: Flags | None = None) -> None:
        left_out = np.zeros(len(bursts.length), bool) if left_out is None else left_out
        if len(bursts.length) > MOST_FITTED:
            packets, left_out = int(bursts.first[MOST_FITTED]), left_out[:MOST_FITTED]
            bursts = LossBursts(packets, bursts.first[:MOST_FITTED], bursts.length[:MOST_FITTED])
        self._bursts, self._left_out = bursts, left_out
        self._likelihood = LossLikelihood(bursts, self._left_out)
        self.lost = int(bursts.length[~self._left_out].sum())
        self.packets = bursts.packets - int(bursts.length[self._left_out].sum())

    @cached_property
    def bernoulli(self) -> ChainFit:
        """Independent losses."""
        estimate = binomial_estimate(self.lost, self.packets)
        share = 0.0 if estimate is None else estimate.value
        rates = ChainRates(0.5, 0.5, _inside(share), _inside(share))
        delivered = self.packets - self.lost
        log_likelihood = float(xlogy(self.lost, share) + xlogy(delivered, 1 - share))
        return ChainFit("bernoulli", rates, {"probability": estimate}, log_likelihood, 1)

    @cached_property
    def gilbert(self) -> ChainFit:
        """Gilbert's chain, with the closed-form estimates p = n_gb/n_g, r = n_bg/n_b."""
        counts = transitions(self._bursts, self._left_out)
        to_bad = binomial_estimate(counts.to_bad, counts.from_good)
        to_good = binomial_estimate(counts.to_good, counts.from_bad)
        p = _inside(0.5 if to_bad is None else to_bad.value)
        r = _inside(0.5 if to_good is None else to_good.value)
        rates = ChainRates(p, r, 0.0, 1.0)
        estimates = {"good_to_bad": to_bad, "bad_to_good": to_good}
        return ChainFit("gilbert", rates, estimates, self._likelihood(rates), 2)

    @cached_property
    def _elliott(self) -> Minimum:
        p, r = self.gilbert.rates[:2]
        starts = [(p, r, 0.0, 1.0)]
        for good, bad in _STARTS:
            # A slow chain around the observed loss rate, and one as fast as the observed bursts.
            share = min(max((self.lost / self.packets - good) / (bad - good), 1e-3), 0.9)
            starts += [(leave * share / (1 - share), leave, good, bad) for leave in (r / 3, r / 20)]
        inner = [np.asarray(logit(np.clip(start, [1e-7, 1e-7, 1e-5, 1e-5], 1 - 1e-5))) for start in starts]
        likeliest = np.argsort(self._costs(np.array(inner)), kind="stable")[:_SEARCHES]
        minima = [minimise(self._costs, inner[start], _LIMIT) for start in likeliest]
        return min(minima, key=lambda minimum: minimum.value)

    def _costs(self, log_odds: Reals) -> Reals:
        """Return minus the log-likelihoods of the rows, (j,)."""
        return np.minimum(-self._likelihood.of_chains(expit(log_odds)), 1e300)

    @cached_property
    def elliott_rates(self) -> ChainRates:
        """The most likely Gilbert–Elliott chain."""
        return _ordered(self._elliott.at)

    @cached_property
    def gilbert_elliott(self) -> ChainFit:
        """Gilbert–Elliott's chain, with intervals."""
        best = self._elliott
        if expit(best.at[2]) > expit(best.at[3]):  # the bad state is the one that loses more
            best = Minimum(best.at[[1, 0, 3, 2]], best.value)
        estimates: dict[str, IntervalEstimate | None] = {}
        for index, name in enumerate(ChainRates._fields):
            ends = profile_interval(self._costs, best, index, _LIMIT)
            estimates[name] = IntervalEstimate(*map(_rounded, (best.at[index], *ends)))
        rates = _ordered(best.at)
        return ChainFit("gilbert_elliott", rates, estimates, -best.value, 4)

    def test(self, fit: ChainFit) -> FitTest:
        """Return the test of the lengths of bursts and deliveries.

        Independent losses are tested against Gilbert's chain, too, by the likelihood ratio: it finds bursts
        in traces that are too short for the test of lengths. Of the two, the test with the smaller p is
        returned, with p doubled (Bonferroni).
        """
        lengths = length_test(self._bursts, self._left_out, fit.rates, fit.parameters)
        if fit.model != "bernoulli" or self.lost < FEWEST_EXPECTED:
            return lengths
        ratio = max(2 * (self.gilbert.log_likelihood - fit.log_likelihood), 0.0)
        p_value = float(stats.chi2.sf(ratio, 1))
        bursts = FitTest(ratio, 1, p_value, "bursts")
        if lengths.p_value is None:
            return bursts
        clearest = bursts if p_value < lengths.p_value else lengths
        return replace(clearest, p_value=min(2 * p_value, 2 * lengths.p_value, 1.0), tests=2)

    def all(self) -> list[ChainFit]:
        """Return the three fits; none without losses."""
        return [self.bernoulli, self.gilbert, self.gilbert_elliott] if self.lost else []

    @cached_property
    def chosen(self) -> ChainFit:
        """The model with the smallest BIC, k ln n − 2 ln L for k parameters."""
        models: tuple[tuple[int, float, Callable[[], ChainFit]], ...] = (
            (1, self.bernoulli.log_likelihood, lambda: self.bernoulli),
            (2, self.gilbert.log_likelihood, lambda: self.gilbert),
            (4, -self._elliott.value, lambda: self.gilbert_elliott),
        )
        penalty = np.log(max(self.packets, 2))
        return min(models, key=lambda model: model[0] * penalty - 2 * model[1])[2]()


def _inside(probability: float) -> float:
    """Return a probability that is neither 0 nor 1, so that the chain is irreducible."""
    return float(np.clip(probability, 1e-9, 1 - 1e-9))


def _rounded(log_odds: float) -> float:
    """Return the probability; at the limit it is 0 or 1."""
    if abs(log_odds) > _LIMIT - 1:
        return float(log_odds > 0)
    return float(expit(log_odds))


def _ordered(log_odds: Reals) -> ChainRates:
    """Return the chain whose bad state loses more."""
    p, r, good, bad = expit(log_odds).tolist()
    return ChainRates(p, r, good, bad) if good <= bad else ChainRates(r, p, bad, good)
