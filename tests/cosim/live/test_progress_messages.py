"""Figures of a run that are shown next to the settings."""

from typing import Any

import numpy as np
import pytest

import noack
from cosim.analysis.summary_model import RunSummary
from cosim.output.figure_drawing import draw
from cosim.output.run_figures import run_figures
from cosim.output.run_tables import key_numbers, short_numbers
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


@pytest.mark.parametrize(("beta", "level"), [(0.02, "βe^(−0.3t), from"), (1e-3, "ε")])
def test_a_claim_names_the_threshold_in_its_bound(beta: float, level: str) -> None:
    settings = {"horizon_s": 1.0, "trigger.beta": beta, "trigger.floor": 0.01}
    run = noack.simulate(noack.load("unstable_pendulum", settings))
    bounds = [claim.bound for claim in run.claims if claim.source == "certificate"]
    of_the_sensor = next(bound for bound in bounds if bound.startswith("‖e_s‖ ≤ "))
    assert level in of_the_sensor
    assert ("β" in of_the_sensor) == ("β" in level)


def test_of_lost_actuations_the_report_has_the_number_and_the_inputs_applied_without_them(
    content: dict[str, Any],
) -> None:
    loss = {"model": "bernoulli", "probability": 0.5}
    network = content["network"] | {"actuation": {"loss": loss, "mansd": 2}}
    plant = content["plant"] | {"watchdog": {"policy": "zero"}}
    record = simulate(resolve(validate(content | {"network": network, "plant": plant}, "")))
    summary = summary_of(record)
    actuations = summary.loops[0].actuations
    assert actuations is not None
    lost = actuations.lost
    assert lost > 0
    for numbers in (key_numbers(summary), short_numbers(summary)):
        assert dict(numbers)["actuations lost"].startswith(f"{lost} (")
    drawn = draw(run_figures(record)["input"]()).axes[0].lines[0].get_ydata()
    applied, sent = record["plant_step"]["u"][:, 0], record["controller_step"]["u"][:, 0]
    late = np.count_nonzero(sent == 0) + 1  # 0 is sent, or applied before the first actuation
    assert np.isin(drawn, applied).all()
    assert np.count_nonzero(np.asarray(drawn) == 0) > late
