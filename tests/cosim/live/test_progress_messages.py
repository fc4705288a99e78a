"""Figures of a run that are shown next to the settings."""

from typing import Any

import pytest

import noack
from cosim.output.run_tables import key_numbers


def simulated(scenario: str, **settings: Any) -> noack.Run:
    named = {key.replace("__", "."): value for key, value in settings.items()}
    return noack.simulate(noack.load(scenario, named))


def test_the_expected_loss_rate_is_shown_beside_the_measured_one() -> None:
    """With loss probability p and cap N, Σ_{k=1…N} p^k drops are expected for each delivery."""
    summary = simulated("lane_following", horizon_s=2.0).summary
    drops = sum(0.8**k for k in range(1, 5))
    assert summary["loss_expected"] == pytest.approx(drops / (1 + drops))
    assert ("  expected loss rate with the cap", "70.3 %") in key_numbers(summary)


def test_a_run_with_changed_losses_has_no_expected_loss_rate() -> None:
    change = {"at_s": 1.0, "set": {"network.loss.probability": 0.2}}
    summary = simulated("lane_following", horizon_s=2.0, changes=[change]).summary
    assert summary["loss_expected"] is None
    assert not any("expected loss" in quantity for quantity, _ in key_numbers(summary))


@pytest.mark.parametrize(("beta", "level"), [(0.02, "βe^(−0.3t), from"), (1e-3, "ε")])
def test_a_claim_names_the_threshold_in_its_bound(beta: float, level: str) -> None:
    run = simulated("unstable_pendulum", horizon_s=1.0, trigger__beta=beta, trigger__floor=0.01)
    bounds = [claim["bound"] for claim in run.claims if claim["source"] == "certificate"]
    of_the_sensor = next(bound for bound in bounds if bound.startswith("‖e_s‖ ≤ "))
    assert level in of_the_sensor
    assert ("β" in of_the_sensor) == ("β" in level)
