"""Fits of loss models to bursts: independent losses, Gilbert's chain, Gilbert–Elliott's chain.

Gilbert's chain loses all packets in the bad state and none in the good one: its states are visible,
and the fit is in closed form. Those of Gilbert–Elliott's are hidden, and its likelihood is
maximised numerically. The intervals are profile-likelihood intervals.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, xlogy

from cosim.measurement.confidence_interval import (
    Estimate,
    Minimum,
    binomial_estimate,
    minimise,
    profile_interval,
)
from cosim.measurement.goodness_of_fit import FitTest, length_test
from cosim.measurement.loss_bursts import Flags, LossBursts
from cosim.measurement.loss_likelihood import ChainRates, LossLikelihood

Reals = NDArray[np.float64]
ModelName = Literal["bernoulli", "gilbert", "gilbert_elliott"]
MOST_FITTED = 5_000
"""Number of bursts that a fit uses, at most: their intervals are within some percent."""
_LIMIT = 18.0
"""Largest log-odds: a probability within 1.5e-8 of 0 or 1 counts as 0 or 1."""
_STARTS = ((0.02, 0.5), (0.2, 0.8), (0.0, 0.5), (0.0, 0.95), (0.05, 0.999))
"""Loss probabilities of the two states, from which the search starts."""
_SEARCHES = 5


@dataclass(frozen=True)
class ChainFit:
    """A loss model with its estimates; those that it fixes are missing."""

    model: ModelName
    rates: ChainRates
    estimates: dict[str, Estimate | None]
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
        value = float(xlogy(self.lost, share) + xlogy(delivered, 1 - share))
        return ChainFit("bernoulli", rates, {"probability": estimate}, value, 1)

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
        inner = [
            np.asarray(logit(np.clip(start, [1e-7, 1e-7, 1e-5, 1e-5], 1 - 1e-5)))
            for start in starts
        ]
        likeliest = sorted(inner, key=self._cost)[:_SEARCHES]
        found = [minimise(self._cost, start, _LIMIT) for start in likeliest]
        return min(found, key=lambda one: one.value)

    def _cost(self, log_odds: Reals) -> float:
        return min(-self._likelihood(ChainRates(*expit(log_odds).tolist())), 1e300)

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
        estimates: dict[str, Estimate | None] = {}
        for place, name in enumerate(ChainRates._fields):
            ends = profile_interval(self._cost, best, place, _LIMIT)
            estimates[name] = Estimate(*map(_rounded, (best.at[place], *ends)))
        rates = _ordered(best.at)
        return ChainFit("gilbert_elliott", rates, estimates, -best.value, 4)

    def tested(self, fit: ChainFit) -> FitTest:
        """Return the test of the lengths of bursts and deliveries."""
        return length_test(self._bursts, self._left_out, fit.rates, fit.parameters)

    def all(self) -> list[ChainFit]:
        """Return the three fits; none without losses."""
        return [self.bernoulli, self.gilbert, self.gilbert_elliott] if self.lost else []

    @cached_property
    def chosen(self) -> ChainFit:
        """The model with the smallest Bayesian information criterion, 2 ln n per parameter."""
        models: tuple[tuple[int, float, Callable[[], ChainFit]], ...] = (
            (1, self.bernoulli.log_likelihood, lambda: self.bernoulli),
            (2, self.gilbert.log_likelihood, lambda: self.gilbert),
            (4, -self._elliott.value, lambda: self.gilbert_elliott),
        )
        penalty = np.log(max(self.packets, 2))
        return min(models, key=lambda one: one[0] * penalty - 2 * one[1])[2]()


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
