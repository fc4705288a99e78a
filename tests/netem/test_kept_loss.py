"""``loss P keep``: the realised loss rate is P, or the words are refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from netem.tc_words import settings_of
from noack.core.errors import CallerError
from noack.impairments import loss_prediction
from noack.impairments.loss_prediction import (
    expected_loss,
    found_probabilities,
    read_files,
    remember,
    with_kept_loss,
)
from noack.protocol.record_tables import Fate


@pytest.mark.parametrize(
    "words",
    [
        "loss 30% keep atmost 3 in 10",
        "loss 25% 50% keep mansd 3 corrupt 5% duplicate 10%",
        "loss 40% keep loss burst 10% 3 mansd 4 atmost 6 in 9",
    ],
)
def test_the_realised_loss_is_the_asked_one(decide: Any, words: str) -> None:
    lost = ~np.isin(decide(words, 500_000, seed=3).fates, (Fate.DELIVERED, Fate.FORCED))
    assert lost.mean() == pytest.approx(float(words.split("%")[0].split()[1]) / 100, abs=2e-3)


def test_the_closed_form_is_inverted() -> None:
    (loss,) = with_kept_loss(settings_of("loss 30% keep mansd 2")).impairments
    p = loss.loss.probability  # type: ignore[attr-defined]
    assert p * (1 - p**2) / (1 - p**3) == pytest.approx(0.3, abs=1e-11)
    assert expected_loss(settings_of("loss 80% keep mansd 4")).rate == pytest.approx(0.8)


def test_what_another_process_found_is_not_computed_again(monkeypatch: Any) -> None:
    """Not even by the loops of a run; but other settings have another probability."""
    settings = settings_of("loss 10% keep loss 5% mansd 1 delay 1ms")
    found = found_probabilities(settings, settings_of("delay 1ms"))
    assert list(found.values()) == [with_kept_loss(settings).impairments[0].loss.probability]  # type: ignore[attr-defined]
    monkeypatch.setattr(loss_prediction, "_found", {})
    monkeypatch.setattr(loss_prediction, "predict", None)
    remember(json.loads(json.dumps(found)))
    assert found_probabilities(settings_of("loss 10% keep loss 5% delay 9ms mansd 1")) == found
    for other in ("loss 10% keep loss 5% mansd 2", "loss 10% keep mansd 1"):
        with pytest.raises(TypeError):
            with_kept_loss(settings_of(other))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("loss 81% keep mansd 4", "impossible with this guarantee, which allows at most 80%"),
        ("loss 10% keep loss 20%", "impossible, the other impairments lose 20% already"),
        ("loss 10% keep loss 10% keep", "only one loss of a direction can be kept"),
        ("loss 10% keep blackout 1s-2s", "cannot be predicted: losses in a blackout"),
    ],
)
def test_what_is_impossible_is_refused_in_one_line(words: str, message: str) -> None:
    where = "links.toml: link.0.forward: loss "
    with pytest.raises(CallerError, match=f"^{where}.*{message}[^\n]*$"):
        read_files(settings_of(words), Path(), where.removesuffix(": loss "))
