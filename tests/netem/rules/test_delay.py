"""Kolmogorov–Smirnov tests of each shape against SciPy; correlations against closed forms.

Seeds are fixed. With random seeds, one in ten thousand such tests would give a p-value below 1e-4.
"""

from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from netem.rule_program import program_of
from noack.impairments.kinds.delay import Delay, quantile_ns
from noack.impairments.kinds.duplicate import Duplicate
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss

COUNT = 100_000
FIXED_NS, JITTER_NS = 50_000_000, 2_000_000
PARETO = stats.pareto(3, loc=-1.5 / np.sqrt(0.75), scale=1 / np.sqrt(0.75))
SHAPES = {"uniform": stats.uniform(-1, 2), "normal": stats.norm(), "pareto": PARETO}


def delays(decide: Any, *before: Any, count: int = COUNT, seed: int = 0, **delay: Any) -> Any:
    settings = {"delay_s": FIXED_NS / 1e9, "jitter_s": JITTER_NS / 1e9} | delay
    return decide([*before, Delay(**settings)], count, seed=seed).delays_ns


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_the_distribution_is_the_named_one(decide: Any, shape: str, correlation: float) -> None:
    found = delays(decide, distribution=shape, correlation=correlation)
    random_part = (found + 0.5 - FIXED_NS) / JITTER_NS  # delays are truncated to whole nanoseconds
    thinned = random_part[:: 1 if correlation == 0 else 20]  # 0.6²⁰: independent
    assert stats.kstest(thinned, SHAPES[shape].cdf).pvalue > 1e-4


@pytest.mark.parametrize("shape", [*SHAPES, "paretonormal"])
def test_mean_and_deviation(decide: Any, shape: str) -> None:
    """Mean 0; the jitter is the standard deviation, or the half-width for a uniform shape.

    The test uses batches, because the Pareto distribution has an infinite fourth moment.
    """
    random_part = (delays(decide, distribution=shape) - FIXED_NS) / JITTER_NS
    deviation = 1 / np.sqrt(3) if shape == "uniform" else 1.0
    assert abs(random_part.mean()) < 5 * deviation / np.sqrt(COUNT)
    assert random_part.std() == pytest.approx(deviation, rel=0.05 if "pareto" in shape else 0.01)


def test_the_mixture_combines_quantiles() -> None:
    """N/4 + 3P/4 of the same u, scaled to standard deviation 1, compared with quadrature."""

    def mixed(u: float) -> float:
        return float(stats.norm.ppf(u) / 4 + PARETO.ppf(u) * 3 / 4)

    def square_at(z: float) -> float:  # in normal scores the integrand is smooth
        tail = stats.norm.sf(z)
        value = z / 4 + PARETO.isf(tail) * 3 / 4
        return float(value**2 * stats.norm.pdf(z))

    variance = sum(quad(square_at, a, b, limit=200)[0] for a, b in ((-9, 0), (0, 6), (6, 36)))
    delay = Delay(jitter_s=1e-9, distribution="paretonormal")
    program = program_of(LinkSettings(impairments=(delay,)), 0, "a")
    for u in np.linspace(0.001, 0.999, 99).tolist():
        found = quantile_ns(program.stages[0], program.reals, u)
        assert found == pytest.approx(mixed(u) / np.sqrt(variance), rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("fixed_ns", [0, 1, 299, 12_345_678, 10**12 + 1])
def test_a_constant_delay_is_exact(decide: Any, fixed_ns: int) -> None:
    assert (delays(decide, delay_s=fixed_ns / 1e9, jitter_s=0.0, count=10) == fixed_ns).all()


def test_observed_delays_have_the_quantiles_of_the_sample(decide: Any) -> None:
    """The delays have NumPy's quantiles of the sample, in any order of the sample."""
    sample_ns = np.random.default_rng(4).gamma(2.0, 3e6, 57)
    sample_ns[:4] = sample_ns[4]  # an atom
    found = delays(decide, jitter_s=0.0, distribution="empirical", samples_s=tuple(sample_ns / 1e9))
    grid = np.linspace(0, 1, 100_001)
    expected = np.floor(FIXED_NS + np.quantile(sample_ns, grid))  # in whole nanoseconds
    assert found.min() >= expected[0] - 1
    assert found.max() <= expected[-1]
    assert stats.ks_2samp(found, expected).pvalue > 1e-4


def test_a_sample_of_two_is_uniform_between_them(decide: Any) -> None:
    found = delays(
        decide, delay_s=0.0, jitter_s=0.0, distribution="empirical", samples_s=(0.002, 0.001)
    )
    assert stats.kstest((found + 0.5) / 1e6, stats.uniform(1, 1).cdf).pvalue > 1e-4


@pytest.mark.parametrize("shape", SHAPES)
def test_no_delay_is_below_zero(decide: Any, shape: str) -> None:
    """A negative delay becomes 0; positive delays keep their distribution."""
    found = delays(decide, delay_s=0.0005, distribution=shape)
    none = SHAPES[shape].cdf(-0.25)
    assert found.min() == 0
    assert abs(np.mean(found == 0) - none) < 5 * np.sqrt(none * (1 - none) / COUNT)
    above = (found[found > 0] - 500_000) / JITTER_NS
    expected = SHAPES[shape]
    u = (expected.cdf(above) - none) / (1 - none)
    assert stats.kstest(u, "uniform").pvalue > 1e-4


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("correlation", [0.3, 0.9])
def test_successive_delays_are_correlated(decide: Any, shape: str, correlation: float) -> None:
    """Their normal scores are an autoregressive process of order one."""
    found = delays(decide, distribution=shape, correlation=correlation)
    u = SHAPES[shape].cdf((found + 0.5 - FIXED_NS) / JITTER_NS)
    z = stats.norm.ppf(u)
    # Bartlett: variance of the measured autocorrelation of an AR(1) process.
    error = np.sqrt((1 + correlation**2) / (1 - correlation**2) / COUNT)
    for lag in (1, 2, 3):
        measured = np.mean(z[lag:] * z[:-lag]) / np.mean(z * z)
        assert abs(measured - correlation**lag) < 5 * error


def test_flows_have_independent_delays(decide: Any) -> None:
    flows = np.arange(COUNT) % 2
    delay = Delay(delay_s=0.05, jitter_s=0.002, distribution="normal", correlation=0.5)
    one, other = decide([delay], COUNT, flows=flows).delays_ns.reshape(-1, 2).T
    assert abs(np.corrcoef(one, other)[0, 1]) < 5 * np.sqrt(5 / 3) / np.sqrt(COUNT / 2)


@pytest.mark.parametrize("of_loss", [-1.0, -0.4, 0.7, 1.0])
@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_delays_are_correlated_with_losses(decide: Any, of_loss: float, correlation: float) -> None:
    """Surviving packets have the mean score −ρ φ(t)/(1 − p), with P(s > t) = p."""
    p = 0.3
    loss = LossOf(loss=BernoulliLoss(probability=p, correlation=correlation))
    found = delays(decide, loss, distribution="normal", loss_correlation=of_loss)
    z = (found + 0.5 - FIXED_NS) / JITTER_NS
    expected = -of_loss * stats.norm.pdf(stats.norm.ppf(p)) / (1 - p)
    assert abs(z.mean() - expected) < 5 * np.sqrt(3 / len(z))  # (1 + 0.5)/(1 − 0.5) = 3
    if of_loss == 1.0:  # the delay determines the loss: survivors have the smallest scores
        threshold = stats.norm.isf(p)
        assert z.max() <= threshold + 1e-6


def test_a_loss_of_probability_0_does_not_change_the_distribution(decide: Any) -> None:
    """A loss of probability 0 has a latent state, too; the same holds for Gilbert–Elliott."""
    calm = GilbertElliottLoss(good_to_bad=0.1, bad_to_good=0.3, loss_in_bad=0.0)
    for loss in (BernoulliLoss(probability=0.0), calm):
        found = delays(
            decide, LossOf(loss=loss), distribution="normal", loss_correlation=0.8, count=400_000
        )
        thinned = ((found + 0.5 - FIXED_NS) / JITTER_NS)[::40]
        assert stats.kstest(thinned, stats.norm.cdf).pvalue > 1e-4


def test_packets_in_the_bad_state_have_long_delays(decide: Any) -> None:
    """With correlation 1, packets that survive the bad state have delays in the top quarter."""
    chain = GilbertElliottLoss(good_to_bad=0.1, bad_to_good=0.3, loss_in_bad=0.5)
    found = delays(decide, LossOf(loss=chain), distribution="uniform", loss_correlation=1.0)
    late = (
        found - FIXED_NS
    ) / JITTER_NS > 0.5  # the upper quarter of the uniform distribution on ± 1
    survive_bad, survive_good = 0.25 * 0.5, 0.75
    expected = survive_bad / (survive_bad + survive_good)
    # The chain correlates successive delays: 1 − p − r = 0.6 doubles the standard error.
    assert abs(late.mean() - expected) < 10 * np.sqrt(expected * (1 - expected) / len(found))


def test_a_copy_draws_its_own_delay_and_changes_no_other_delay(decide: Any) -> None:
    delay = Delay(delay_s=0.05, jitter_s=0.002, distribution="normal", correlation=0.7)
    alone = decide([delay], COUNT).verdicts
    doubled = decide([Duplicate(probability=0.5), delay], COUNT).verdicts
    copied = doubled["copy_ns"] >= 0
    np.testing.assert_array_equal(alone["release_ns"][~copied], doubled["release_ns"][~copied])
    own = alone["release_ns"][copied]
    first, second = doubled["release_ns"][copied], doubled["copy_ns"][copied]
    assert ((own == first) | (own == second)).all()  # the earlier of the two is the first
    arrivals = np.arange(COUNT)[copied] * 1000
    copy = np.where(own == first, second, first) - arrivals
    z = (copy + 0.5 - FIXED_NS) / JITTER_NS
    assert stats.kstest(z[::10], stats.norm.cdf).pvalue > 1e-4
    measured = np.corrcoef(z, (own - arrivals - FIXED_NS) / JITTER_NS)[0, 1]
    assert abs(measured - 0.7) < 5 * np.sqrt(3 / len(z))


def test_the_longest_delay_fits_into_an_integer(decide: Any) -> None:
    found = delays(decide, count=200_000, delay_s=3600.0, jitter_s=3600.0, distribution="pareto")
    assert found.min() >= 0
    assert found.max() <= 10**15
