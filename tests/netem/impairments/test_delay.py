"""Delays, corruption, duplicates and reordering, against SciPy's distributions and closed forms."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from netem.core.core_library import core, ffi
from netem.impairments.kinds.delay import Delay
from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.trace import TraceLoss
from netem.impairments.target_loss import read_files
from netem.link_state import LinkState
from netem.tc_words import settings_of
from tests.helpers.approved import compare_lines, lines_of_error

COUNT = 100_000
FIXED_NS, JITTER_NS = 50_000_000, 2_000_000
PARETO = stats.pareto(3, loc=-1.5 / np.sqrt(0.75), scale=1 / np.sqrt(0.75))
SHAPES = {"uniform": stats.uniform(-1, 2), "normal": stats.norm(), "pareto": PARETO}


def random_parts(decide: Any, words: str, *, before: str = "") -> Any:
    """Return the delays minus 50 ms, in units of 2 ms; delays are truncated to whole ns."""
    delays_ns = decide(f"{before} delay 50ms 2ms {words}", COUNT).delays_ns
    return (delays_ns + 0.5 - FIXED_NS) / JITTER_NS


def assert_distributed(parts: Any, shape: Any) -> None:
    assert stats.kstest(parts, shape.cdf).pvalue > 1e-4


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_delays_have_the_set_shape_and_correlation(decide: Any, shape: str, correlation: float) -> None:
    """The normal scores of successive delays are an autoregressive process of order one."""
    parts = random_parts(decide, f"{100 * correlation}% distribution {shape}")
    assert_distributed(parts[:: 1 if correlation == 0 else 20], SHAPES[shape])  # 0.6²⁰: independent
    z = stats.norm.ppf(SHAPES[shape].cdf(parts))
    # Bartlett: variance of the measured autocorrelation of an AR(1) process.
    error = np.sqrt((1 + correlation**2) / (1 - correlation**2) / COUNT)
    for lag in (1, 2, 3):
        measured = np.mean(z[lag:] * z[:-lag]) / np.mean(z * z)
        assert abs(measured - correlation**lag) < 5 * error


def test_the_paretonormal_delay_combines_the_quantiles_of_both() -> None:
    """N/4 + 3P/4 of the same u, scaled to standard deviation 1, compared with quadrature."""

    def mixed(u: float) -> float:
        return float(stats.norm.ppf(u) / 4 + PARETO.ppf(u) * 3 / 4)

    def square_at(z: float) -> float:  # in normal scores the integrand is smooth
        value = z / 4 + PARETO.isf(stats.norm.sf(z)) * 3 / 4
        return float(value**2 * stats.norm.pdf(z))

    variance = sum(quad(square_at, a, b, limit=200)[0] for a, b in ((-9, 0), (0, 6), (6, 36)))
    delay = Delay(jitter_s=1e-9, distribution="paretonormal")
    quantile = quantile_of(LinkSettings(impairments=(delay,)))
    for u in np.linspace(0.001, 0.999, 99).tolist():
        assert quantile(u) == pytest.approx(mixed(u) / np.sqrt(variance), rel=1e-7, abs=1e-9)
    # Of the largest uniform number, the unbounded distribution is cut: it fits into an integer.
    longest = quantile_of(settings_of("delay 3600s 3600s distribution pareto"))
    assert 1e15 < longest(1 - 2**-53) < 2**62


def quantile_of(settings: LinkSettings) -> Callable[[float], float]:
    """The delay in ns that belongs to a uniform number."""
    state = LinkState(settings, 0, "a")
    delay = ffi.addressof(core.noack_link_stages(state.core)[0], "delay")
    return lambda u: float(core.noack_delay_quantile_ns(delay, core.noack_link_reals(state.core), u))


def test_observed_delays_have_the_quantiles_of_the_sample(decide: Any) -> None:
    """The delays have NumPy's quantiles of the sample, in any order of the sample."""
    sample_ns = np.random.default_rng(4).gamma(2.0, 3e6, 57)
    sample_ns[:4] = sample_ns[4]  # an atom
    delay = Delay(delay_s=0.05, distribution="empirical", samples_s=tuple(sample_ns / 1e9))
    delays_ns = decide(LinkSettings(impairments=(delay,), limit=1_000_000), COUNT).delays_ns
    grid = np.linspace(0, 1, 100_001)
    expected = np.floor(FIXED_NS + np.quantile(sample_ns, grid))  # in whole nanoseconds
    assert delays_ns.min() >= expected[0] - 1
    assert delays_ns.max() <= expected[-1]
    assert stats.ks_2samp(delays_ns, expected).pvalue > 1e-4


@pytest.mark.parametrize("shape", SHAPES)
def test_negative_delays_become_0(decide: Any, shape: str) -> None:
    """Positive delays keep their distribution."""
    delays_ns = decide(f"delay 0.5ms 2ms distribution {shape}", COUNT).delays_ns
    cdf = SHAPES[shape].cdf
    below = cdf(-0.25)
    assert delays_ns.min() == 0
    assert abs(np.mean(delays_ns == 0) - below) < 5 * np.sqrt(below * (1 - below) / COUNT)
    above = cdf((delays_ns[delays_ns > 0] - 500_000) / JITTER_NS)
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


def test_a_copy_draws_its_own_delay_and_changes_no_other_delay(
    decide: Any, share_is: Callable[..., None]
) -> None:
    words = "delay 50ms 2ms 70% distribution normal"
    alone = decide(words, COUNT).decisions
    doubled = decide(f"duplicate 50% {words}", COUNT).decisions
    copied = doubled["copy_ns"] >= 0
    share_is(copied, 0.5)
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


@pytest.mark.parametrize("size_bytes", [1, 100, 65_507])
def test_every_bit_is_flipped_with_the_same_probability(
    decide: Any, share_is: Callable[..., None], size_bytes: int
) -> None:
    decided = decide("corrupt 50%", 200_000, sizes_bytes=size_bytes)
    bits = decided.decisions["bit"][decided.fates == 3]
    share_is(decided.fates == 3, 0.5)
    assert ((decided.decisions["bit"] >= 0) == (decided.fates == 3)).all()
    assert bits.min() >= 0
    assert bits.max() < 8 * size_bytes
    empty = decide("corrupt 100%", 100, sizes_bytes=np.arange(100) % 2)
    assert empty.fates.tolist() == [0, 3] * 50
    counts = np.histogram(bits, min(8 * size_bytes, 800), (0, 8 * size_bytes))[0]
    assert stats.chisquare(counts).pvalue > 1e-4


@pytest.mark.parametrize("gap", [1, 5])
def test_reordered_packets_leave_at_once(decide: Any, share_is: Callable[..., None], gap: int) -> None:
    decided = decide(f"delay 10ms reorder 30% gap {gap}", 100_000)
    at_once = decided.delays_ns == 0
    assert set(decided.delays_ns.tolist()) == {0, 10_000_000}
    share_is(at_once, 1 / (gap - 1 + 1 / 0.3))
    assert np.diff(np.flatnonzero(at_once), prepend=-1).min() == gap
    # Only delays before the reorder are skipped.
    assert (decide("delay 10ms reorder 100% delay 3ms", 10).delays_ns == 3_000_000).all()


@pytest.mark.parametrize(("correlation", "gap"), [(0, 5), (50, 5), (90, 3)])
def test_a_packet_is_a_candidate_until_it_leaves_at_once(
    decide: Any, share_is: Callable[..., None], correlation: int, gap: int
) -> None:
    """As in tc: the share is 1/(N − 1 + 1/P), which a correlation of the draws does not change."""
    words = f"delay 10ms reorder 20% {correlation}% gap {gap}"
    at_once = decide(words, 400_000).delays_ns == 0
    share_is(at_once, 1 / (gap - 1 + 5))
    distances = np.diff(np.flatnonzero(at_once))
    assert distances.min() == gap
    assert (distances % gap != 0).any()


def test_lost_packets_are_no_candidates(decide: Any) -> None:
    delays_ns = decide("delay 10ms loss periodic 1/2 reorder 100% gap 3", 18).delays_ns
    assert (delays_ns == 0).tolist() == [False, False, True] * 3


@pytest.mark.parametrize(
    "words", ["delay 10ms 10ms", "duplicate 50% delay 0ms 3ms", "loss 50% delay 5ms 5ms 80%"]
)
def test_an_ordered_delay_keeps_the_order_of_each_flow(decide: Any, words: str) -> None:
    """What would be earlier leaves with the packet before it; the longest delay is the same."""
    flows = np.arange(40_000) % 2
    free, ordered = (decide(f"{words}{end}", 40_000, flows=flows) for end in ("", " ordered"))
    assert free.fates.tolist() == ordered.fates.tolist()
    for flow in (0, 1):
        times = []
        for column in ("release_ns", "copy_ns"):
            times.append(ordered.decisions[column][flows == flow])
            assert (np.diff(times[-1][times[-1] >= 0]) >= 0).all()
        if "duplicate" not in words:
            wanted = free.decisions["release_ns"][flows == flow]
            kept = wanted >= 0
            assert times[0][kept].tolist() == np.maximum.accumulate(wanted[kept]).tolist()
            assert ordered.delays_ns.max() <= free.delays_ns.max()


def read_delay(folder: Path, **settings: Any) -> Delay:
    delay = Delay(distribution="empirical", **settings)
    (read,) = read_files(LinkSettings(impairments=(delay,)), folder).impairments
    assert isinstance(read, Delay)
    return read


def test_observed_delays_have_units_comments_and_signs(tmp_path: Path) -> None:
    (tmp_path / "delays.txt").write_text("# from a ping\n0.01\n12.5ms\n\n300 us\n-5ns\n1e-3\n")
    delay = read_delay(tmp_path, delay_s=0.02, file="delays.txt")
    assert delay.samples_s == pytest.approx((0.01, 0.0125, 3e-4, -5e-9, 1e-3), rel=1e-15)
    assert (delay.file, delay.longest_s) == (None, pytest.approx(0.0325))
    assert delay.delay_s == 0.02


def test_a_tc_distribution_table_is_scaled_by_the_jitter(tmp_path: Path) -> None:
    (tmp_path / "some.dist").write_text("# a table\n -8192 -4096 0\n 8192 16384\n")
    delay = read_delay(tmp_path, delay_s=0.02, jitter_s=0.002, file="some.dist")
    assert delay.samples_s == pytest.approx((-0.002, -0.001, 0, 0.002, 0.004), rel=1e-15)


def test_a_mistake_in_a_file_of_delays_or_losses_gives_the_approved_line(tmp_path: Path) -> None:
    def mistake(line: str) -> list[str]:
        name, jitter_s, content = json.loads(line)
        (tmp_path / name).unlink(missing_ok=True)
        if content is not None:
            (tmp_path / name).write_bytes(content.encode("latin-1"))
        if jitter_s is not None:
            return lines_of_error(lambda: read_delay(tmp_path, jitter_s=jitter_s, file=name))
        losses = LinkSettings(impairments=(LossOf(loss=TraceLoss(file=name)),))
        return lines_of_error(lambda: read_files(losses, tmp_path, "links.toml: link.0.reverse"))

    compare_lines(Path(__file__).with_name("delay_mistakes.txt"), mistake)
