"""Settings of a link that depend on each other; mistakes in single ones: mistakes.txt."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.rate import Rate
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss


def message(adapter: TypeAdapter[Any], content: Any) -> str:
    with pytest.raises(ValidationError) as caught:
        adapter.validate_json(json.dumps(content))
    return "\n".join(error["msg"] for error in caught.value.errors())


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
