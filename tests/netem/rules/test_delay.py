"""Kolmogorov–Smirnov tests of each shape against SciPy; correlations against closed forms.

Seeds are fixed. With random seeds, one in ten thousand such tests would give a p-value below 1e-4.
"""

from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from netem.link_state import LinkState
from netem.tc_words import settings_of
from noack.core.core_library import core, ffi
from noack.impairments.kinds.delay import Delay
from noack.impairments.link_settings import LinkSettings

COUNT = 100_000
FIXED_NS, JITTER_NS = 50_000_000, 2_000_000
PARETO = stats.pareto(3, loc=-1.5 / np.sqrt(0.75), scale=1 / np.sqrt(0.75))
SHAPES = {"uniform": stats.uniform(-1, 2), "normal": stats.norm(), "pareto": PARETO}


def random_parts(decide: Any, words: str, *, before: str = "", count: int = COUNT) -> Any:
    """Return the delays minus 50 ms, in units of 2 ms; delays are truncated to whole ns."""
    found = decide(f"{before} delay 50ms 2ms {words}", count).delays_ns
    return (found + 0.5 - FIXED_NS) / JITTER_NS


def assert_distributed(found: Any, shape: Any) -> None:
    assert stats.kstest(found, shape.cdf).pvalue > 1e-4


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_shape_and_correlation(decide: Any, shape: str, correlation: float) -> None:
    """The normal scores of successive delays are an autoregressive process of order one."""
    found = random_parts(decide, f"{100 * correlation}% distribution {shape}")
    assert_distributed(found[:: 1 if correlation == 0 else 20], SHAPES[shape])  # 0.6²⁰: independent
    z = stats.norm.ppf(SHAPES[shape].cdf(found))
    # Bartlett: variance of the measured autocorrelation of an AR(1) process.
    error = np.sqrt((1 + correlation**2) / (1 - correlation**2) / COUNT)
    for lag in (1, 2, 3):
        measured = np.mean(z[lag:] * z[:-lag]) / np.mean(z * z)
        assert abs(measured - correlation**lag) < 5 * error


def test_the_mixture_combines_quantiles() -> None:
    """N/4 + 3P/4 of the same u, scaled to standard deviation 1, compared with quadrature."""

    def mixed(u: float) -> float:
        return float(stats.norm.ppf(u) / 4 + PARETO.ppf(u) * 3 / 4)

    def square_at(z: float) -> float:  # in normal scores the integrand is smooth
        value = z / 4 + PARETO.isf(stats.norm.sf(z)) * 3 / 4
        return float(value**2 * stats.norm.pdf(z))

    variance = sum(quad(square_at, a, b, limit=200)[0] for a, b in ((-9, 0), (0, 6), (6, 36)))
    delay = Delay(jitter_s=1e-9, distribution="paretonormal")
    state = LinkState(LinkSettings(impairments=(delay,)), 0, "a")
    link = state.core
    for u in np.linspace(0.001, 0.999, 99).tolist():
        found = core.noack_delay_quantile_ns(ffi.addressof(link.stages[0], "delay"), link.reals, u)
        assert found == pytest.approx(mixed(u) / np.sqrt(variance), rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("fixed_ns", [0, 1, 12_345_678, 10**12 + 1])
def test_a_constant_delay_is_exact(decide: Any, fixed_ns: int) -> None:
    assert (decide(f"delay {fixed_ns}ns", 10).delays_ns == fixed_ns).all()


def test_observed_delays_have_the_quantiles_of_the_sample(decide: Any) -> None:
    """The delays have NumPy's quantiles of the sample, in any order of the sample."""
    sample_ns = np.random.default_rng(4).gamma(2.0, 3e6, 57)
    sample_ns[:4] = sample_ns[4]  # an atom
    delay = Delay(delay_s=0.05, distribution="empirical", samples_s=tuple(sample_ns / 1e9))
    found = decide(LinkSettings(impairments=(delay,), limit=1_000_000), COUNT).delays_ns
    grid = np.linspace(0, 1, 100_001)
    expected = np.floor(FIXED_NS + np.quantile(sample_ns, grid))  # in whole nanoseconds
    assert found.min() >= expected[0] - 1
    assert found.max() <= expected[-1]
    assert stats.ks_2samp(found, expected).pvalue > 1e-4


@pytest.mark.parametrize("shape", SHAPES)
def test_negative_delays_become_0(decide: Any, shape: str) -> None:
    """Positive delays keep their distribution."""
    found = decide(f"delay 0.5ms 2ms distribution {shape}", COUNT).delays_ns
    cdf = SHAPES[shape].cdf
    below = cdf(-0.25)
    assert found.min() == 0
    assert abs(np.mean(found == 0) - below) < 5 * np.sqrt(below * (1 - below) / COUNT)
    above = cdf((found[found > 0] - 500_000) / JITTER_NS)
    assert_distributed((above - below) / (1 - below), stats.uniform())


@pytest.mark.parametrize("of_loss", [-0.4, 1.0])
@pytest.mark.parametrize("correlation", [0, 50])
def test_delays_are_correlated_with_losses(decide: Any, of_loss: float, correlation: int) -> None:
    """Surviving packets have the mean score −ρ φ(t)/(1 − p), with P(s > t) = p."""
    p = 0.3
    z = random_parts(
        decide, f"distribution normal lossrel {100 * of_loss}%", before=f"loss 30% {correlation}%"
    )
    expected = -of_loss * stats.norm.pdf(stats.norm.ppf(p)) / (1 - p)
    assert abs(z.mean() - expected) < 5 * np.sqrt(3 / len(z))  # (1 + 0.5)/(1 − 0.5) = 3
    if of_loss == 1.0:  # the delay determines the loss: survivors have the smallest scores
        assert z.max() <= stats.norm.isf(p) + 1e-6


@pytest.mark.parametrize("loss", ["loss 0%", "loss gemodel 10% 30% 0%"])
def test_a_loss_of_probability_0_does_not_change_the_distribution(decide: Any, loss: str) -> None:
    found = random_parts(decide, "distribution normal lossrel 80%", before=loss, count=400_000)
    assert_distributed(found[::40], stats.norm)


def test_packets_in_the_bad_state_have_long_delays(decide: Any) -> None:
    """With correlation 1, packets that survive the bad state have delays in the top quarter."""
    found = random_parts(decide, "lossrel 100%", before="loss gemodel 10% 30% 50%")
    late = found > 0.5  # the upper quarter of the uniform distribution on ± 1
    survive_bad, survive_good = 0.25 * 0.5, 0.75
    expected = survive_bad / (survive_bad + survive_good)
    # The chain correlates successive delays: 1 − p − r = 0.6 doubles the standard error.
    assert abs(late.mean() - expected) < 10 * np.sqrt(expected * (1 - expected) / len(found))


def test_a_copy_draws_its_own_delay_and_changes_no_other_delay(decide: Any) -> None:
    words = "delay 50ms 2ms 70% distribution normal"
    alone = decide(words, COUNT).decisions
    doubled = decide(f"duplicate 50% {words}", COUNT).decisions
    copied = doubled["copy_ns"] >= 0
    np.testing.assert_array_equal(alone["release_ns"][~copied], doubled["release_ns"][~copied])
    own = alone["release_ns"][copied]
    first, second = doubled["release_ns"][copied], doubled["copy_ns"][copied]
    assert ((own == first) | (own == second)).all()  # the earlier of the two is the first
    arrivals = np.arange(COUNT)[copied] * 1000
    copy = np.where(own == first, second, first) - arrivals
    z = (copy + 0.5 - FIXED_NS) / JITTER_NS
    assert_distributed(z[::10], stats.norm)
    measured = np.corrcoef(z, (own - arrivals - FIXED_NS) / JITTER_NS)[0, 1]
    assert abs(measured - 0.7) < 5 * np.sqrt(3 / len(z))


def test_the_longest_delay_fits_into_an_integer() -> None:
    """Of the largest uniform number, the unbounded distribution is cut at 10¹⁵ ns."""
    state = LinkState(settings_of("delay 3600s 3600s distribution pareto"), 0, "a")
    link = state.core
    u = 1 - 2**-53
    assert (
        core.noack_delay_quantile_ns(ffi.addressof(link.stages[0], "delay"), link.reals, u) > 1e15
    )
    assert link.stages[0].delay.constant_ns == 3600e9
