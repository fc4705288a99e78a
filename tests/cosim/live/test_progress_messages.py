"""What a person is told of a run: numbers beside what was asked for, and who is at fault."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

import noack
from cosim.live.coordinator import Coordinator
from cosim.live.launcher import _overdue
from cosim.live.start_limit import StartLimit
from cosim.output.run_tables import key_numbers
from noack.protocol.topology import RECORDER


def simulated(scenario: str, **settings: Any) -> noack.Run:
    named = {key.replace("__", "."): value for key, value in settings.items()}
    return noack.simulate(noack.load(scenario, named))


def test_what_the_network_loses_in_the_long_run_is_told_beside_what_it_lost() -> None:
    """Of a chance p under a cap N: Σ_{k=1…N} p^k drops for each delivery."""
    summary = simulated("lane_following", horizon_s=2.0).summary
    drops = sum(0.8**k for k in range(1, 5))
    assert summary["loss_expected"] == pytest.approx(drops / (1 + drops))
    assert ("  expected loss rate with the cap", "70.3 %") in key_numbers(summary)


def test_of_a_run_that_is_changed_no_long_run_is_told() -> None:
    change = {"at_s": 1.0, "set": {"network.loss.probability": 0.2}}
    summary = simulated("lane_following", horizon_s=2.0, changes=[change]).summary
    assert summary["loss_expected"] is None
    assert not any("expected loss" in quantity for quantity, _ in key_numbers(summary))


@pytest.mark.parametrize(("beta", "level"), [(0.02, "βe^(−0.3t), from"), (1e-3, "ε")])
def test_a_claim_names_the_level_that_its_bound_is_a_multiple_of(beta: float, level: str) -> None:
    run = simulated("unstable_pendulum", horizon_s=1.0, trigger__beta=beta, trigger__floor=0.01)
    bounds = [claim["bound"] for claim in run.claims if claim["source"] == "certificate"]
    of_the_sensor = next(bound for bound in bounds if bound.startswith("‖e_s‖ ≤ "))
    assert level in of_the_sensor
    assert ("β" in of_the_sensor) == ("β" in level)


@pytest.mark.parametrize(
    ("here", "named"), [(("plant", RECORDER), "plant"), ((RECORDER,), RECORDER)]
)
def test_a_run_that_does_not_end_names_who_did_not(here: tuple[str, ...], named: str) -> None:
    coordinator = SimpleNamespace(epoch_ns=0, finished=lambda role: role not in here)
    said = _overdue(cast(Coordinator, coordinator), StartLimit(30.0))
    assert said == f"the run did not end at its horizon: no end came from {named}"
