"""Predicted and kept loss rates, and probabilities of bursts, against closed forms and many decisions."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from netem.core.packet_rows import Fate
from netem.guarantee.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
    LossHistory,
)
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_prediction import LossPrediction, LossProcess, predict
from netem.impairments.markov_chain import NotPredictableError
from netem.impairments.target_loss import loss_process, read_files
from netem.tc_words import settings_of
from noack.machines.run_channel import Datagram
from tests.helpers.approved import compare_lines, lines_of_error
from tests.netem.stepped_link import Link

DECISIONS = 400_000
EXACT = {
    "": 0.0,
    "loss none mansd 3": 0.0,
    "duplicate 100% loss 50%": 0.25,
    "duplicate 20% loss 50%": 0.8 * 0.5 + 0.2 * 0.25,
    "loss 50% duplicate 100%": 0.5,
    "duplicate 100% corrupt 50% loss 50%": 0.75**2,
    # Each copy has its own draw; the state of the second is that of the next packet.
    "duplicate 100% loss gemodel 25% 25%": 0.5 * 0.75,
    "duplicate 100% loss gemodel 0% 0% 100% 10%": 0.01,
    "duplicate 100% loss periodic 2/100": 0.02,  # both copies have the packet's number
    "loss worst": 1.0,
    "loss worst mansd 4": 4 / 5,
    "loss worst mansd 0": 0.0,
    "loss 100% 50% mansd 1000000": 1_000_000 / 1_000_001,
    "loss periodic 2/100": 0.02,
    "loss periodic 100/100 mansd 3": 3 / 4,
    "loss periodic 7/100 from 3 mansd 2": 5 / 100,  # lost, lost, not, lost, lost, not, lost
    "loss script 0,1,2,7,8,9 every 10 mansd 4": 5 / 10,  # six losses, across the end
    "loss script none every 10": 0.0,
    "loss periodic 1/2 loss periodic 1/3": 4 / 6,
    "loss 0% 50% atmost 3 in 11": 0.0,
    "loss 100% atmost 3 in 10 mansd 2": 3 / 10,
    "loss worst mansd 2 recover 3": 2 / 5,
    "loss periodic 1/2 atmost 1 in 3": 1 / 4,  # only every other loss
    "loss worst atmost 2 in 4 recover 1 mansd 1": 1 / 2,
    # Of a reducible chain, the prediction depends on its start.
    "loss gemodel 0% 0% 100% 10%": 0.1,  # stays good
    "loss gemodel 10% 0% 60% 10%": 0.6,  # ends up bad
    "loss gemodel 100% 100% 100% 0% mansd 1": 0.5,  # alternates
    "loss gemodel 0.0001% 0.0001%": 0.5,
    "loss state 100% 100% 0% 100% 0%": 0.5,
    "loss state 0% 0% 0% 0% 100%": 0.5,  # every other is a single loss
    "replay records 0s+1ms,1s+lost,2s+lost,3s+lost,4s+1ms": 3 / 5,
    "replay records 0s+1ms,1s+lost,2s+lost,3s+lost,4s+1ms mansd 2": 2 / 5,
    "replay records 0s+1ms,1s+2ms by time": 0.0,
}


def predicted_loss(words: str) -> float | None:
    return predict(settings_of(words)).rate


def test_predicted_losses_are_those_of_the_closed_form() -> None:
    for words, rate in EXACT.items():
        assert predicted_loss(words) == pytest.approx(rate, rel=1e-9), words
    for p in (0.05, 0.5, 0.97):
        for m in (0, 1, 4, 17):
            rate = p * (1 - p**m) / (1 - p ** (m + 1))
            predicted = predicted_loss(f"loss {100 * p}% mansd {m}")
            assert predicted == pytest.approx(rate, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    "words",
    [
        "loss gemodel 5% 2% 97% 10% mansd 4",
        "loss state 10% 20% 3% 40% 5% mansd 2",
        "loss 20% 90% mansd 3",
        "loss 85% 30% mansd 6",
        "loss burst 10% 3 loss burst 10% 5 loss 3% mansd 4",
        "loss periodic 3/20 loss 20% mansd 3",
        "loss script 1,2,3,4,5 every 9 loss gemodel 10% 30% mansd 5",
        "corrupt 10% 50% mansd 1",
        "loss 20% corrupt 30% mansd 2",
        "corrupt 20% duplicate 50% corrupt 40% duplicate 30% mansd 2",
        "duplicate 40% 60% corrupt 30%",
        "delay 1ms 1ms loss 30% reorder 20% mansd 2",
        "loss 40% atmost 3 in 8 atmost 5 in 16 recover 2 mansd 2",
        "loss 30% 60% atmost 2 in 9",
        "loss 60% mansd 3 recover 4",
        "loss burst 20% 4 mansd 3 recover 2",
        "loss gemodel 5% 2% 97% 10% atmost 4 in 12",
        "loss periodic 3/20 loss 20% atmost 2 in 7",
        "corrupt 20% duplicate 50% loss 20% mansd 2 recover 3",
        "duplicate 50% loss 40%",
        "duplicate 60% loss 30% loss 20% mansd 2",
        "duplicate 100% loss gemodel 10% 30%",
        "duplicate 100% loss gemodel 10% 30% 80% 5% mansd 3",
        "duplicate 100% loss state 10% 20% 3% 40% 5% mansd 4",
        "duplicate 70% 50% loss 40% mansd 3",
        "duplicate 100% corrupt 40% 90% loss 10% mansd 2",
        "duplicate 50% loss 30% duplicate 50% corrupt 20% loss 30% atmost 2 in 5",
        "duplicate 100% loss periodic 3/20 loss 20% mansd 3",
    ],
)
def test_many_decisions_have_the_predicted_loss(decide: Any, share_is: Any, words: str) -> None:
    predicted = predicted_loss(words)
    assert predicted is not None
    fates = decide(words, DECISIONS, seed=5).fates
    share_is(~np.isin(fates, (Fate.DELIVERED, Fate.FORCED)), predicted)


def test_a_missing_prediction_has_the_approved_reason() -> None:
    def reason(words: str) -> list[str]:
        if "keep" in words:
            return lines_of_error(lambda: read_files(settings_of(words), Path(), "FILE"))
        prediction = predict(settings_of(words))
        assert prediction.rate is None
        return [prediction.note]

    compare_lines(Path(__file__).with_name("predictions.txt"), reason)


QUEUE = "as long as no queue overflows"
OUT_OF_ORDER = "not counting packets delivered out of order (stale)"


P = 0.3
INDEPENDENT = {"kind": "loss", "loss": {"model": "bernoulli", "probability": P}}
BURSTY = {
    "kind": "loss",
    "loss": {
        "model": "gilbert_elliott", "good_to_bad": 0.2, "bad_to_good": 0.4,
        "loss_in_good": 0.1, "loss_in_bad": 0.9,
    },
}  # fmt: skip
KEPT = [
    LossGuarantee((LongestBurst(2),)),
    LossGuarantee((LongestBurst(3), LossesInWindow(3, 6))),
    LossGuarantee((LongestBurst(2), DeliveriesBetweenBursts(2))),
]


def process(*impairments: dict[str, object], first: bool = False) -> LossProcess:
    return loss_process(LinkSettings.model_validate({"impairments": impairments, "first_delivered": first}))


def probability(losses: LossProcess, outcomes: tuple[bool, ...]) -> float:
    """The probability of these outcomes (True: lost), following every state of the chain."""
    weights = losses.start
    for number, lost in enumerate(outcomes):
        weights = weights @ losses.transitions
        forced = number == 0 and losses.first_delivered
        weights = weights * (float(not lost) if forced else losses.lost if lost else 1 - losses.lost)
    return float(weights.sum())


def is_kept(guarantee: LossGuarantee, outcomes: tuple[bool, ...]) -> bool:
    history = LossHistory(guarantee.rules)
    return not any(history.add(lost) for lost in outcomes)


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("guarantee", KEPT, ids=lambda guarantee: guarantee.meaning)
@pytest.mark.parametrize("impairments", [[INDEPENDENT], [BURSTY], [BURSTY, INDEPENDENT]])
def test_a_guarantee_is_kept_with_the_total_probability_of_all_patterns_that_keep_it(
    impairments: list[dict[str, object]], guarantee: LossGuarantee, first: bool
) -> None:
    losses = process(*impairments, first=first)
    patterns = list(product([False, True], repeat=8))
    expected = sum(probability(losses, pattern) for pattern in patterns if is_kept(guarantee, pattern))
    assert losses.keeps(guarantee, 8) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    "words",
    [
        "loss periodic 2/3 from 1",
        "loss periodic 2/3 from 2",
        "loss periodic 3/4 from 40",
        "loss periodic 1/5 from 3 loss periodic 2/9 from 31",
        "replay records 0+5ms,1ms+5ms,2ms+lost,3ms+lost,4ms+5ms from 3ms",
        "replay records 0+5ms,1ms+5ms,2ms+lost,3ms+lost,4ms+5ms",
    ],
)
def test_certain_losses_begin_where_the_link_begins_them(words: str) -> None:
    """No packet before the first one of a periodic loss is lost; a trace begins at its offset."""
    link, losses = Link(settings_of(words), 1, "a"), loss_process(settings_of(words))
    lost = tuple(link.decide(0, 72, t_ns * 10**9).fate == Fate.DROPPED for t_ns in range(60))
    chain = losses.outcomes(LossGuarantee())
    shares = np.eye(len(chain.lost))[-1]
    for is_lost in lost:
        assert (shares @ chain.lost).sum() == is_lost
        shares = shares @ (chain.lost + chain.delivered)
    for packets in range(60):
        for guarantee in KEPT:
            assert losses.keeps(guarantee, packets) == is_kept(guarantee, lost[:packets])


def test_losses_that_begin_anywhere_in_a_trace_are_not_predicted() -> None:
    settings = settings_of("replay records 0+5ms,1ms+lost from random")
    assert predict(settings).rate == 0.5
    with pytest.raises(NotPredictableError, match="a seed chooses"):
        loss_process(settings)


def test_a_kept_rate_is_that_of_the_losses_under_the_guarantee() -> None:
    """p(1 − p²)/(1 − p³) = 0.4 for the probability p of the losses without the guarantee."""
    kept = {"kind": "loss", "loss": {"model": "bernoulli", "probability": 0.4, "keep": True}}
    p = loss_process(LinkSettings.model_validate({"impairments": (kept,), "mansd": 2})).lost.max()
    assert p * (1 - p**2) / (1 - p**3) == pytest.approx(0.4, rel=1e-9)


def test_losses_are_not_predicted_if_few_packets_may_be_delayed_at_once() -> None:
    """A copy that finds no place is dropped: without the limit a quarter of the packets is lost."""
    settings = settings_of("duplicate 100% corrupt 50% delay 10ms").model_copy(update={"limit": 1})
    note = "as long as no more than 1 packet is delayed at once"
    assert predict(settings) == LossPrediction(0.25, note)
    with pytest.raises(NotPredictableError, match=note):
        loss_process(settings)
    link = Link(settings, 1, "a")
    for t_ns in range(0, 1000 * 10**9, 10**9):
        link.handle(Datagram(0, bytes(72)), t_ns)
        link.on_timer(t_ns)
    assert link.counters.corrupted == pytest.approx(500, abs=60)


@pytest.mark.parametrize(
    ("words", "mean_burst"),
    [
        ("loss 30%", 1 / 0.7), ("loss burst 10% 5", 5.0), ("loss worst mansd 4", 4.0),
        ("loss 50% mansd 2", (0.5 + 0.25) / 0.5), ("loss periodic 7/100 mansd 3", 7 / 2),
        ("loss burst 20% 4 mansd 3", None), ("loss 40% mansd 2 atmost 2 in 6", None),
        ("duplicate 50% loss gemodel 5% 20% 80% 2% mansd 4", None),
    ],
)  # fmt: skip
def test_the_bursts_behind_a_guarantee_and_the_spread_of_their_rate(
    decide: Any, words: str, mean_burst: float | None
) -> None:
    """Mean and variance, against closed forms and many decisions in parts."""
    settings = settings_of(words)
    outcomes = loss_process(settings).outcomes(settings.guarantee)
    parts, size = 400, 1000
    lost = decide(words, parts * size, seed=3).decisions["release_ns"] < 0
    bursts = np.count_nonzero(lost[1:] & ~lost[:-1])
    assert outcomes.mean_burst == pytest.approx(np.count_nonzero(lost) / bursts, rel=0.03)
    if mean_burst is not None and "periodic" not in words:
        assert outcomes.mean_burst == pytest.approx(mean_burst)
    # The relative standard error of the variance of 400 parts is 7 %.
    variance = lost.reshape(parts, size).sum(axis=1).var() / size
    assert outcomes.variance == pytest.approx(variance, rel=0.35, abs=5e-3)
