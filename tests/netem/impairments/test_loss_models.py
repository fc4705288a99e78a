"""Loss models and blackouts, against closed forms and definitions."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy import stats

from netem.core.packet_rows import Fate
from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from netem.impairments.loss_models.trace import TraceLoss
from netem.impairments.target_loss import read_files
from netem.tc_words import settings_of
from tests.netem.stepped_link import Link

COUNT = 400_000
Joint = Callable[[int], float]
"""Probability that a packet and the one ``lag`` later are lost; for lag 0 the loss rate."""


def correlated(p: float, correlation: float = 0.0) -> Joint:
    """P(z₁ > t, z₂ > t) for bivariate normal z, with P(z > t) = p; AR(1): at lag k it is ρᵏ."""
    t = stats.norm.ppf(p)

    def joint(lag: int) -> float:
        covariance = [[1.0, correlation**lag], [correlation**lag, 1.0]]
        normal = stats.multivariate_normal(cov=covariance, allow_singular=True)
        return p if lag == 0 else float(normal.cdf([t, t]))

    return joint


def chain(transitions: Any, losses: Sequence[float]) -> Joint:
    """For a Markov chain: π Λ Pᵏ Λ 1, with its stationary distribution π."""
    P, lost = np.array(transitions), np.array(losses)
    values, vectors = np.linalg.eig(P.T)
    stationary = np.real(vectors[:, np.argmax(np.real(values))])
    stationary /= stationary.sum()

    def joint(lag: int) -> float:
        later = np.linalg.matrix_power(P, lag) @ lost if lag else np.ones(len(lost))
        return float(stationary * lost @ later)

    return joint


def two_states(p: float, r: float, good: float = 0.0, bad: float = 1.0) -> Joint:
    return chain([[1 - p, p], [r, 1 - r]], [good, bad])


def four_states(p13: float, p31: float, p32: float, p23: float, p14: float) -> Any:
    return [[1 - p13 - p14, 0, p13, p14], [0, 1 - p23, p23, 0], [p31, p32, 1 - p31 - p32, 0],
            [1, 0, 0, 0]]  # fmt: skip


LOST = [0.0, 0.0, 1.0, 1.0]
JOINT: dict[str, Joint] = {
    "loss 30%": correlated(0.3),
    "loss 2% 90%": correlated(0.02, 0.9),
    "loss 80% 70%": correlated(0.8, 0.7),
    "loss gemodel 5% 25%": two_states(0.05, 0.25),
    "loss gemodel 10% 30% 60% 5%": two_states(0.1, 0.3, 0.05, 0.6),
    "loss burst 60% 8": two_states(0.6 / 0.4 / 8, 1 / 8),
    "loss state 5% 20%": chain(four_states(0.05, 0.2, 0, 1, 0), LOST),
    "loss state 2% 10% 30% 40% 3%": chain(four_states(0.02, 0.1, 0.3, 0.4, 0.03), LOST),
    "loss state 10% 50% 50% 90% 90%": chain(four_states(0.1, 0.5, 0.5, 0.9, 0.9), LOST),
}


@pytest.mark.parametrize("words", JOINT)
def test_losses_have_the_rate_and_the_joint_probabilities(
    decide: Any, share_is: Callable[..., None], words: str
) -> None:
    lost = decide(words, COUNT).fates == 1
    share_is(lost, JOINT[words](0))
    for lag in (1, 2, 5):
        share_is(lost[lag:] & lost[:-lag], JOINT[words](lag))


@pytest.mark.parametrize(
    ("words", "start", "transitions", "losses"),
    [
        ("loss 20% 95%", [1.0], [[1.0]], [0.2]),  # the latent process is stationary from the start
        ("loss gemodel 20% 1%", [1.0, 0.0], [[0.8, 0.2], [0.01, 0.99]], [0.0, 1.0]),
        ("loss state 2% 10% 30% 40% 3%", [1.0, 0, 0, 0], four_states(0.02, 0.1, 0.3, 0.4, 0.03),
         LOST),
    ],
)  # fmt: skip
def test_the_chain_begins_in_its_first_state_and_moves_before_each_packet(
    decide: Any, words: str, start: list[float], transitions: Any, losses: list[float]
) -> None:
    """The distribution of the k-th packet's state is e₁ Pᵏ⁺¹ (average over many flows)."""
    flows, steps = 20_000, 3
    fates = decide(words, steps * flows, flows=np.tile(np.arange(flows), steps)).fates
    state = np.array(start)
    for of_step in fates.reshape(steps, flows) == 1:
        state = state @ np.array(transitions)
        p = float(state @ losses)
        assert abs(of_step.mean() - p) <= 5 * np.sqrt(p * (1 - p) / flows)


def lost_packets(words: str, packets: Any) -> list[bool]:
    """Return which packets are lost; another script comes first, so the table offset is not 0."""
    link = Link(settings_of(f"loss script {2**39},{2**39 + 1} {words}"), 0, "a")
    link.decide(0, 1, 0)
    flow = link.flow(0)
    assert flow is not None
    losses = []
    for flow.packets in packets:
        losses.append(link.decide(0, 1, 0).fate == 1)
    return losses


@pytest.mark.parametrize("share", [0, 1])
def test_probabilities_0_and_1_are_exact(decide: Any, share: int) -> None:
    never = ["loss 0%", "loss 0% 99.9%", "loss gemodel 0% 0%", "loss burst 0% 1", "loss none"]
    always = ["loss 100%", "loss 100% 99.9%", "loss gemodel 100% 0%", "loss worst"]
    for words in always if share else never:
        assert (decide(words, 10_000).fates == share).all()


@given(st.sets(st.integers(0, 60)), st.integers(0, 40))
def test_exactly_the_packets_of_a_script_are_lost(numbers: set[int], extra: int) -> None:
    """A script applied once, a repeated script, and one with a large number."""
    script = ",".join(map(str, sorted(numbers))) or "none"
    assert lost_packets(f"loss script {script}", range(80)) == [k in numbers for k in range(80)]
    every = max(numbers, default=0) + 1 + extra
    again = lost_packets(f"loss script {script} every {every}", range(300))
    assert again == [k % every in numbers for k in range(300)]
    last = 2**40 - 1
    assert lost_packets(f"loss script 0,{last}", [last - 1, last, last + 1]) == [False, True, False]


@given(st.integers(1, 30), st.data(), st.integers(0, 50))
def test_periodic_loss_drops_a_burst_in_every_period(period: int, data: st.DataObject, first: int) -> None:
    burst = data.draw(st.integers(0, period))
    lost = lost_packets(f"loss periodic {burst}/{period} from {first}", range(200))
    assert lost == [k >= first and (k - first) % period < burst for k in range(200)]


STEP_NS = 10_000_000
P, R = 0.02, 0.1


def common_state() -> Link:
    """A Gilbert–Elliott chain whose state all flows of a link share."""
    own = GilbertElliottLoss(good_to_bad=P, bad_to_good=R, state="link", step_s=STEP_NS * 1e-9)
    return Link(LinkSettings(impairments=(LossOf(loss=own),), first_delivered=False), 7, "x")


def test_a_common_bad_state_concerns_all_flows_at_once() -> None:
    link = common_state()
    states = [
        {link.decide(k, 1, step * STEP_NS + k * STEP_NS // 50).fate == 1 for k in range(50)}
        for step in range(500)
    ]
    assert all(len(seen) == 1 for seen in states)
    assert 0 < sum(seen == {True} for seen in states) < 500


@pytest.mark.parametrize("every", [1, 7, 1000])
def test_common_states_at_a_distance_follow_the_powers_of_the_matrix(every: int) -> None:
    """Also if most steps are without a packet."""
    link, count = common_state(), 20_000
    bad = np.array([link.decide(i % 3, 1, i * every * STEP_NS).fate == 1 for i in range(count)])
    transitions = np.linalg.matrix_power(np.array([[1 - P, P], [R, 1 - R]]), every)
    for state in (0, 1):
        after = bad[1:][bad[:-1] == state]
        expected = transitions[state, 1]
        spread = np.sqrt(expected * (1 - expected) / len(after))
        assert abs(after.mean() - expected) < 5 * spread


@given(st.sets(st.integers(0, 50), min_size=2), st.none() | st.integers(0, 30))
def test_a_blackout_loses_packets_from_begin_to_just_before_end(borders: set[int], extra: int | None) -> None:
    ends = sorted(borders)[: len(borders) // 2 * 2]
    intervals = list(zip(ends[::2], ends[1::2], strict=True))
    period = None if extra is None else ends[-1] + extra
    words = "blackout " + ",".join(f"{a}us-{b}us" for a, b in intervals)
    if period is not None:
        words += f" every {period}us"
    # Another blackout comes first, so that the interval's table offset is not 0.
    link = Link(settings_of(f"blackout 10s-11s {words}"), 0, "a")
    borders_ns = [1000 * t for t in range(200)]
    for t_ns in sorted({*borders_ns, *(t - 1 for t in borders_ns[1:])}):
        place = t_ns if period is None else t_ns % (1000 * period)
        expected = any(1000 * a <= place < 1000 * b for a, b in intervals)
        assert link.decide(0, 1, t_ns).fate == (5 if expected else 0)


def test_outages_of_a_file_are_a_blackout_of_these_intervals(tmp_path: Path) -> None:
    (tmp_path / "outages.txt").write_text("# from a log\n3ms 0.005s\n\n9ms 10ms\n")
    link = Link(read_files(settings_of("outages outages.txt"), tmp_path), 0, "a")
    lost = [t_ms for t_ms in range(20) if link.decide(0, 1, t_ms * 10**6).fate == 5]
    assert lost == [3, 4, 9]


@given(st.floats(0, 0.99), st.floats(1, 1000))
def test_means_determine_the_chain(loss: float, burst: float) -> None:
    """Bursts last 1/r on average, the loss rate is p/(p + r); refused exactly if p exceeds 1."""
    if loss / (1 - loss) > burst:
        with pytest.raises(ValidationError, match="needs longer bursts"):
            GilbertElliottLoss(mean_loss=loss, mean_burst=burst)
        return
    p, r = GilbertElliottLoss(mean_loss=loss, mean_burst=burst).transitions
    assert 1 / r == pytest.approx(burst)
    assert p / (p + r) == pytest.approx(loss)


@pytest.mark.parametrize("repeat", [True, False])
def test_a_trace_drops_the_packets_it_marks(repeat: bool, tmp_path: Path) -> None:
    (tmp_path / "trace.txt").write_text("0100 1\n11\t0\r\n")
    settings = LinkSettings(impairments=(LossOf(loss=TraceLoss(file="trace.txt", repeat=repeat)),))
    link = Link(read_files(settings, tmp_path), 0, "test")
    fates = [link.decide(0, 100, 0).fate for _ in range(20)]
    marks = [int(mark) for mark in "01001110"]
    assert fates == (marks * 3 if repeat else marks + [0] * 12)[:20]
    assert Fate.DROPPED == 1
