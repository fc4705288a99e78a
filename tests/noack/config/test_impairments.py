"""Link settings that are refused, and the error messages."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from noack.impairments.kinds import AnyImpairment
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.rate import Rate
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models import Loss
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss

LOSS: TypeAdapter[Loss] = TypeAdapter(Loss)
ONE: TypeAdapter[AnyImpairment] = TypeAdapter(AnyImpairment)

LOSS_MISTAKES: list[tuple[dict[str, Any], str]] = [
    ({"model": "bernoulli", "probability": 1.1}, "less than or equal to 1"),
    ({"model": "bernoulli", "probability": 0.1, "correlation": 1.0}, "less than 1"),
    ({"model": "bernoulli", "probability": 0.1, "correlaton": 0.5}, "not permitted"),
    ({"model": "gilbert_elliott"}, "good_to_bad: give good_to_bad and bad_to_good, or mean_loss"),
    ({"model": "gilbert_elliott", "mean_loss": 0.1}, "good_to_bad: give good_to_bad and"),
    ({"model": "gilbert_elliott", "good_to_bad": 0.1, "bad_to_good": 0.1, "mean_loss": 0.1},
     "mean_loss: goes instead of good_to_bad and bad_to_good"),
    ({"model": "gilbert_elliott", "mean_loss": 0.1, "mean_burst": 2.0, "loss_in_bad": 0.5},
     "mean_loss: mean_loss and mean_burst go with loss_in_good 0 and loss_in_bad 1"),
    ({"model": "gilbert_elliott", "mean_loss": 0.9, "mean_burst": 2.0},
     "mean_burst: so much loss needs longer bursts, at least mean_loss/(1 − mean_loss) = 9"),
    ({"model": "gilbert_elliott", "mean_loss": 1.0, "mean_burst": 2.0}, "less than 1"),
    ({"model": "four_state", "p13": 0.1, "p31": 0.7, "p32": 0.4}, "p31: p31 + p32 must not exceed"),
    ({"model": "four_state", "p13": 0.6, "p31": 0.7, "p14": 0.5}, "p13: p13 + p14 must not exceed"),
    ({"model": "periodic", "period": 4, "burst": 5}, "burst: must not exceed the period, 4"),
    ({"model": "scripted", "lost": [3, 3]}, "lost: the numbers must ascend"),
    ({"model": "scripted", "lost": [-1]}, "greater than or equal to 0"),
    ({"model": "scripted", "lost": [1, 5], "repeat_every": 5},
     "repeat_every: the script is longer, up to 5"),
    ({"model": "trace"}, "Field required"),
    ({"model": "gilbert"}, "does not match any of the expected tags"),
]  # fmt: skip

MISTAKES: list[tuple[dict[str, Any], str]] = [
    ({"kind": "jitter"}, "does not match any of the expected tags"),
    ({"kind": "delay", "delay_s": -0.1}, "greater than or equal to 0"),
    ({"kind": "delay", "delay_s": float("nan")}, "finite number"),
    ({"kind": "delay", "distribution": "empirical"},
     "samples_s: an empirical distribution needs samples_s, or a file"),
    ({"kind": "delay", "distribution": "empirical", "samples_s": [0.1, 0.2], "file": "a.txt"},
     "samples_s: an empirical distribution needs samples_s, or a file"),
    ({"kind": "delay", "samples_s": [0.1, 0.2]}, 'samples_s: goes with distribution = "empirical"'),
    ({"kind": "delay", "distribution": "normal", "file": "a.txt"},
     'samples_s: goes with distribution = "empirical"'),
    ({"kind": "delay", "distribution": "empirical", "samples_s": [0.1]}, "at least 2 items"),
    ({"kind": "rate", "rate_bps": 1, "queue": 1_000_000},
     "rate_bps: a full queue of the longest packets would take more than a century"),
    ({"kind": "blackout", "intervals_s": []}, "at least 1 item"),
    ({"kind": "blackout", "intervals_s": [[2.0, 1.0]]},
     "intervals_s: each must end after it begins, and before the next"),
    ({"kind": "blackout", "intervals_s": [[1.0, 2.0], [1.5, 3.0]]},
     "intervals_s: each must end after it begins, and before the next"),
    ({"kind": "blackout", "intervals_s": [[1.0, 2.0]], "every_s": 1.5},
     "every_s: the intervals last longer, until 2 s"),
]  # fmt: skip


def message(adapter: TypeAdapter[Any], content: Any) -> str:
    with pytest.raises(ValidationError) as caught:
        adapter.validate_json(json.dumps(content))
    return "\n".join(error["msg"] for error in caught.value.errors())


@pytest.mark.parametrize(("content", "words"), LOSS_MISTAKES)
def test_an_invalid_loss_model_is_refused_with_the_reason(
    content: dict[str, Any], words: str
) -> None:
    assert words in message(LOSS, content)
    assert words in message(ONE, {"kind": "loss", "loss": content})


@pytest.mark.parametrize(("content", "words"), MISTAKES)
def test_an_invalid_impairment_is_refused_with_the_reason(
    content: dict[str, Any], words: str
) -> None:
    assert words in message(ONE, content)
    assert words in message(TypeAdapter(LinkSettings), {"impairments": [content]})


@pytest.mark.parametrize(
    "before",
    [
        [],
        [{"kind": "loss", "loss": {"model": "worst_case"}}],
        [
            {"kind": "loss", "loss": {"model": "bernoulli", "probability": 0.1}},
            {"kind": "loss", "loss": {"model": "periodic", "period": 3}},
        ],
    ],
)
def test_a_delay_that_depends_on_the_loss_state_needs_a_loss_with_states(before: list[Any]) -> None:
    late = {"kind": "delay", "jitter_s": 0.1, "loss_correlation": 0.5}
    refused = message(TypeAdapter(LinkSettings), {"impairments": [*before, late]})
    assert f"impairments.{len(before)}.loss_correlation: needs a loss before it" in refused
    loss = {"kind": "loss", "loss": {"model": "bernoulli", "probability": 0.1}}
    LinkSettings.model_validate_json(json.dumps({"impairments": [*before, loss, late]}))


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


def test_the_longest_delay_is_the_sum_of_the_maximum_delays() -> None:
    settings = LinkSettings(
        impairments=(
            Delay(delay_s=0.1, jitter_s=0.01),
            Delay(jitter_s=0.01, distribution="normal"),
            Delay(delay_s=0.2, distribution="empirical", samples_s=(0.3, 0.1)),
            Rate(rate_bps=12_000_000, queue=100),
        )
    )
    assert settings.longest_delay_s == pytest.approx(0.11 + 0.04 + 0.5 + 0.1)
