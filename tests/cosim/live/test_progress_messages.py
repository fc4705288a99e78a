"""Figures of a run that are shown next to the settings."""

from typing import Any

import pytest

from cosim.analysis.summary_model import RunSummary
from cosim.output.run_tables import key_numbers
from cosim.simulation.virtual_time import simulate
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.cosim.summaries import summary_of


def simulated(content: dict[str, Any]) -> RunSummary:
    return summary_of(simulate(resolve(validate(content, ""))))


def test_the_expected_loss_rate_is_shown_beside_the_measured_one(content: dict[str, Any]) -> None:
    """With loss probability p and cap N, Σ_{k=1…N} p^k drops are expected for each delivery."""
    summary = simulated(content)
    drops = 0.5 + 0.5**2
    assert summary.loops[0].loss_expected == pytest.approx(drops / (1 + drops))
    assert ("  expected loss rate with the cap", "42.9 %") in key_numbers(summary)


def test_a_run_with_changed_losses_has_no_expected_loss_rate(content: dict[str, Any]) -> None:
    change = {"at_s": 0.5, "set": {"network.loss.probability": 0.2}}
    summary = simulated(content | {"changes": [change]})
    assert summary.loops[0].loss_expected is None
    assert not any("expected loss" in quantity for quantity, _ in key_numbers(summary))
