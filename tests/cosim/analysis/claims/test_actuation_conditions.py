"""The conditions of a run whose actuations cross the network, against those of its certificates."""

from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.summary_model import ClaimVerdict
from cosim.output.certificate_report import Certificates
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError
from noack.core.linear_systems import transition
from noack.protocol.record_tables import PLANT_ACTUATION, PLANT_STEP
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.certificates.conditions import nominal_conditions

SCENARIOS = Path(__file__).parents[4] / "scenarios"
WORST = 'loss={model="worst_case"}'
RANDOM = 'loss={model="bernoulli", probability=0.4}'
DELAY = 'impairments=[{kind="delay", delay_s=0.013}]'
JITTER = 'impairments=[{kind="delay", delay_s=0.02, jitter_s=0.02}]'


def scenario(actuation: str, *more: str) -> Scenario:
    path = SCENARIOS / "lane_following.toml"
    base = ["horizon_s=3", "trigger.beta=0.05", f"network.actuation={{{actuation}}}"]
    return resolve(load(path, [*base, *more]))


@pytest.mark.parametrize("predictions", [1, 2, 6])
@pytest.mark.parametrize(
    ("actuation", "reached"),
    [
        (f"mansd=0, {RANDOM}", True), (f"mansd=1, {WORST}", True), (f"mansd=3, {WORST}", True),
        (f"mansd=3, {RANDOM}, {DELAY}", False), (f"mansd=2, {RANDOM}, {JITTER}", False),
    ],
)  # fmt: skip
@pytest.mark.parametrize("rates", [(100, 100, 0.5), (100, 50, 0.0), (500, 100, 0.3)])
def test_no_run_leaves_the_conditions_of_its_schedule_and_some_reach_them(
    actuation: str, reached: bool, predictions: int, rates: tuple[float, float, float]
) -> None:
    plant_hz, controller_hz, phase = rates
    run = scenario(
        actuation, f"controller.predictions={predictions}", f"plant.rate_hz={plant_hz}",
        f"controller.rate_hz={controller_hz}", f"controller.phase={phase}",
    )  # fmt: skip
    allowed, found = nominal_conditions(run, 0), read_conditions(simulate(run)).summary()
    for name in ("delay_s", "hold_s", "start_s"):
        assert found[name] is not None
        assert found[name] <= getattr(allowed, name) + 1e-9, name  # type: ignore[operator]
    if reached and predictions == 1:
        assert found["hold_s"] == pytest.approx(allowed.hold_s, abs=1e-9)


@pytest.mark.parametrize("predictions", [1, 4])
@pytest.mark.parametrize("policy", ["hold", "zero"])
@pytest.mark.parametrize("actuation", [f"mansd=3, {WORST}", f"mansd=3, {RANDOM}"])
def test_the_claims_of_a_run_are_judged_where_the_watchdog_stays_idle(
    actuation: str, policy: str, predictions: int
) -> None:
    run = scenario(
        actuation, f"controller.predictions={predictions}", f'plant.watchdog.policy="{policy}"'
    )
    verdicts = [claim.verdict for claim in ClaimEvaluation(simulate(run)).judge()]
    idle = policy == "hold" or predictions == 4
    assert run.coverage.is_certifiable == idle
    # (I1) and eq:LossEv3 need no certificate.
    assert len(verdicts) > 10 if idle else len(verdicts) == 3
    assert set(verdicts) == {ClaimVerdict.HELD}


def test_what_is_not_covered_is_refused_with_the_reason() -> None:
    for run, says in (
        (scenario(RANDOM), "the age of the applied input has no bound"),
        (scenario("mansd=1", 'plant.watchdog.policy="model"'), "use more controller.predictions"),
    ):
        with pytest.raises(CallerError, match=says):
            Certificates(run, 2)
    with pytest.raises(CallerError, match=r"network\.actuation"):
        scenario("mansd=1").coverage.require_exact()


def test_the_difference_to_the_controllers_input_is_what_the_updates_in_between_changed() -> None:
    """u_applied − K x_c = −K Σ e^{H(s − t_i)} jump_i over the updates after the actuation."""
    run = scenario(
        f"mansd=3, {RANDOM}", "controller.predictions=4", "plant.rate_hz=100",
        "controller.rate_hz=100", 'trigger={policy="periodic", period_s=0.03}',
    )  # fmt: skip
    record, loop, tick_ns = simulate(run), loop_of(run), run.timing.controller_period_ns
    received, updates = record[PLANT_ACTUATION], record["controller_delivery"]
    ticks = record["controller_step"]
    differing = 0
    for step in record[PLANT_STEP][4:]:
        newest = received[received["sequence"] == step["actuation"]][0]
        entry = int(step["entry"])
        s_ns = int(newest["t_ns"]) + entry * tick_ns
        own = ticks["u"][ticks["sequence"] == step["actuation"] + entry][0]
        between = updates[
            (updates["model_t_ns"] > newest["t_ns"]) & (updates["model_t_ns"] <= s_ns)
        ]
        jumps = sum(
            (transition(loop.H, s_ns - int(row["model_t_ns"])) @ (row["x_c"] - row["x_c_before"])
             for row in between),
            np.zeros(loop.n),
        )  # fmt: skip
        np.testing.assert_allclose(own - step["u"], loop.K @ jumps, rtol=1e-7, atol=1e-9)
        differing += len(between) > 0
    assert differing > 3
