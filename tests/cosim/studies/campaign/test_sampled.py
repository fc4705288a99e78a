"""The measures of a sampled campaign: runs in virtual time."""

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

from cosim.analysis.run_summary import summarise
from cosim.record.run_record import RunRecord
from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS
from cosim.simulation.virtual_time import simulate
from cosim.studies.campaign.random_draws import drawn_scenario
from cosim.studies.campaign.sampled_draws import SampledWork, in_virtual_time
from noack.core.errors import ExitStatus
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load as load_scenario

SHIPPED = Path(__file__).parents[4] / "scenarios"
COARSE = ("horizon_s=4.0", "plant.rate_hz=50.0", "controller.rate_hz=50.0")
SPREAD = "plant.initial_state_halfwidth=[0.5, 0.1, 0.1, 2.0]"
LATE = 'network.impairments=[{kind = "delay", delay_s = 0.03}]'
NEVER = (
    "network.protocol=ack",
    "network.acknowledgements.loss.model=bernoulli",
    "network.acknowledgements.loss.probability=1.0",
)


def scenario(*overrides: str) -> Scenario:
    return load_scenario(SHIPPED / "lane_following.toml", [*COARSE, SPREAD, *overrides])


def work(*overrides: str, **changed: Any) -> SampledWork:
    settings: dict[str, Any] = {"Q": None, "R": None, "settle": 0.5, "most_events": 1000}
    return SampledWork(in_virtual_time(scenario(*overrides)), 7, **settings | changed)


def record_of(one: SampledWork, draw: int) -> RunRecord:
    return simulate(drawn_scenario(one.scenario, one.seed, draw))


@pytest.mark.parametrize("overrides", [(), (LATE,), NEVER, ("mode=zoh",)])
def test_a_row_agrees_with_the_summary_of_the_run(overrides: tuple[str, ...]) -> None:
    one = work(*overrides)
    for draw, row in enumerate(one.run(range(2))):
        record = record_of(one, draw)
        expected = summarise(record, ExitStatus.OK, "").to_json()
        assert row["status"] == OK
        assert row["transmissions"] == expected["events"]
        assert row["deliveries"] == expected["deliveries"]
        assert row["final_norm"] == pytest.approx(expected["final_state_norm"], rel=1e-12)
        shortest_s = math.nan if expected["events"] < 2 else expected["inter_event_min_s"]
        assert row["inter_event_min_s"] == pytest.approx(shortest_s, rel=1e-12, nan_ok=True)
        norms = np.linalg.norm(record["plant_step"]["x"], axis=1)
        last_s = record["plant_step"]["t_ns"][norms > 0.5 * norms[0]][-1] * 1e-9
        settled_s = last_s if norms[-1] <= 0.5 * norms[0] else math.nan
        assert row["settling_s"] == pytest.approx(settled_s, nan_ok=True)
        # e^{0.25 t} grows from 1 to e over the horizon.
        assert expected["sup_e_c_norm"] <= row["sup_e_c_scaled"] <= np.e * expected["sup_e_c_norm"]


GUSTS = (
    'plant.disturbances=[{kind = "gaussian", std = [3.0, 1.0]},'
    ' {kind = "uniform", at = "state", bound = [0.5, 0.0, 0.0, 2.0]}]'
)


@pytest.mark.parametrize("overrides", [(), (GUSTS,)])
def test_the_cost_is_the_integral_under_the_held_inputs(overrides: tuple[str, ...]) -> None:
    """Disturbances enter the cost only through the state."""
    Q, R = np.diag([1.0, 2.0, 3.0, 4.0]), np.diag([0.5, 0.25])
    one = work("horizon_s=0.1", *overrides, Q=Q, R=R)
    (row,) = one.run(range(1))
    record = record_of(one, 0)
    cost = 0.0
    for step in record["plant_step"][:-1]:
        d, w = (step["d"], step["w"]) if overrides else (0.0, 0.0)
        drift = np.zeros((5, 5))
        drift[:4, :4], drift[:4, 4] = record.loop.A, record.loop.B @ (step["u"] + d) + w

        def rate(s: float, z: Any, G: Any) -> float:
            x = (expm(G * s) @ z)[:4]
            return float(x @ Q @ x)

        of_x = partial(rate, z=np.append(step["x"], 1.0), G=drift)
        cost += quad_vec(of_x, 0.0, 0.02, epsrel=1e-12)[0] + 0.02 * step["u"] @ R @ step["u"]
    assert row["cost"] == pytest.approx(cost, rel=1e-10)


def test_a_nonlinear_plant_is_drawn_and_its_cost_is_a_sum() -> None:
    given = load_scenario(SHIPPED / "cart_pole.toml", ["horizon_s=1.0", "plant.rate_hz=200.0"])
    one = SampledWork(in_virtual_time(given), 7, None, None, 0.5, 1000)
    (row,) = one.run(range(1))
    record = record_of(one, 0)
    steps = record["plant_step"]
    assert row["status"] == OK
    assert not record.scenario.coverage.is_linear
    of_x = (steps["x"] ** 2).sum(axis=1)
    expected = np.trapezoid(of_x, dx=0.005) + 0.005 * (steps["u"][:-1] ** 2).sum()
    assert row["cost"] == pytest.approx(expected, rel=1e-12)


def test_every_draw_has_its_own_disturbances_and_noise() -> None:
    noisy = ('plant.disturbances=[{kind = "gaussian", std = [1.0, 1.0]}]',
             "plant.measurement.noise_std=[0.1, 0.1, 0.1, 0.1]")  # fmt: skip
    seeds = [drawn_scenario(work(*noisy).scenario, 7, draw).seeds for draw in range(3)]
    assert len({(s.disturbance, s.noise, s.loss) for s in seeds}) == 3
    assert len({s.disturbance for s in seeds} | {s.noise for s in seeds}) == 6


def test_a_draw_depends_only_on_its_number() -> None:
    one = work(*NEVER)
    assert one.run(range(1, 2)).tobytes() == one.run(range(2))[1:].tobytes()


def test_a_failed_run_has_the_status_of_its_failure() -> None:
    growing = "model.gain=[[0, 0, 0, 0], [0, 0, 0, 0]]"
    (row,) = work(
        growing, "model.allow_unstable=true",
        "horizon_s=2000.0", "plant.rate_hz=5.0", "controller.rate_hz=5.0",
    ).run(range(1))  # fmt: skip
    assert row["status"] == DIVERGED
    assert 0 < row["diverged_at_s"] < 2000
    assert np.isnan(row["cost"])
    (row,) = work("mode=zoh", most_events=2).run(range(1))
    assert (row["status"], np.isnan(row["cost"])) == (TOO_MANY_EVENTS, True)
