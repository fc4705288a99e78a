"""A diverging run is distinguished from a disturbed, saturated, short or oscillating one."""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.run_summary import summarise
from cosim.record.run_events import GROWTH, Divergence, divergence
from cosim.simulation.continuous import run_continuous, summary
from cosim.simulation.virtual_time import simulate
from noack.core.linear_systems import Matrix, Vector
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate

T_S = np.linspace(0.0, 10.0, 1001)


def scenario(content: dict[str, Any], **plant: Any) -> Scenario:
    content["plant"] |= plant
    return resolve(validate(content, "test"))


def at_0_unless(condition: Any) -> Matrix:
    return np.stack([np.where(condition, 1.0, 0.0), np.zeros_like(T_S)], axis=1)


def exponential(rate_per_s: float) -> Matrix:
    return np.exp(rate_per_s * T_S)[:, None] * [1.0, 0.5]


def diverged(x: Matrix, scenarios: list[Scenario]) -> Divergence | None:
    """The result must not depend on the parts in which the samples are read."""
    found = [
        divergence(zip(np.split(T_S, cuts), np.split(x, cuts), strict=True), len(T_S), scenarios)
        for cuts in ([], [50, 700, 705])
    ]
    assert found[0] == found[1]
    return found[0]


@pytest.mark.parametrize("rate_per_s", [1.0, 4.64, 30.0])
def test_an_unstable_loop_has_diverged(content: dict[str, Any], rate_per_s: float) -> None:
    found = diverged(exponential(rate_per_s), [scenario(content)])
    assert found is not None
    assert 0 < found.at_s < 10
    assert "still growing at the end" in found.text
    assert "\n" not in found.text
    x = exponential(-rate_per_s)
    x[300:, 1] = np.inf
    found = diverged(x, [scenario(content)])
    assert found is not None
    assert (found.at_s, found.text) == (3.0, "diverged: x is not finite at 3 s")


def shapes() -> dict[str, Matrix]:
    rng = np.random.default_rng(0)
    one, wave = np.ones_like(T_S), np.sin(3 * T_S)
    rows: dict[str, Vector] = {
        "stable": np.exp(-T_S),
        "slowly unstable, so that the run is short": np.exp(0.6 * T_S),
        "an overshoot": 1e-3 + 1e6 * T_S * np.exp(-3 * T_S),
        "a limit cycle from next to nothing": 1e-9 + np.minimum(np.exp(6 * T_S - 30), 1) * wave,
        "saturated far away": 1e-6 + 1e5 * np.minimum(T_S / 5, 1),
        "noise": rng.normal(size=len(T_S)),
        "at rest": 0 * one,
    }
    return {name: values[:, None] * [1.0, 0.1] for name, values in rows.items()}


@pytest.mark.parametrize("name", shapes())
def test_a_bounded_run_is_not_reported_as_diverged(content: dict[str, Any], name: str) -> None:
    assert diverged(shapes()[name], [scenario(content)]) is None


def test_a_disturbance_or_set_point_sets_the_scale_of_the_state(content: dict[str, Any]) -> None:
    content["trigger"]["beta"] = 1e-9
    late = at_0_unless(T_S >= 9.5) + 1e-12
    plain = scenario(content)
    # nothing in the run explains a state of this size
    assert diverged(late, [plain]) is not None
    step = {"kind": "step", "amplitude": [1.0], "from_s": 0.0}
    assert diverged(late, [scenario(content, disturbances=[step])]) is None
    moved = plain.controller.model_copy(update={"setpoint": (1.0, 0.0)})
    assert diverged(late, [plain, plain.model_copy(update={"controller": moved})]) is None


def unstable(content: dict[str, Any], horizon_s: float) -> Scenario:
    """The sign convention of Matlab, on purpose: A + BK has the eigenvalue 4.64."""
    content["model"] = {
        "A": [[0.0, 1.0], [3.0, -0.5]], "B": [[0.0], [1.0]], "gain": [[6.16, 3.17]],
        "allow_unstable": True,
    }  # fmt: skip
    return scenario(content | {"horizon_s": horizon_s}, draw="nominal", initial_state=[0.1, 0.0])


def test_a_simulated_run_that_diverges_fails(content: dict[str, Any]) -> None:
    resolved = unstable(content, 8.0)
    sampled = summarise(simulate(resolved), 0, "horizon").to_json()
    continuous = summary(run_continuous(resolved), resolved).to_json()
    for found in (sampled, continuous):
        assert found["exit"]["status"] == 1
        assert found["exit"]["reason"].startswith("diverged: ‖x‖ passed ")
        assert 1e6 < found["final_state_norm"] < np.inf
    assert sampled["diverged_at_s"] == pytest.approx(continuous["diverged_at_s"], abs=0.1)
    stopped = summarise(simulate(resolved), 130, "stopped by the user (SIGINT)").to_json()
    assert stopped["exit"] == {"status": 130, "reason": "stopped by the user (SIGINT)"}
    assert stopped["diverged_at_s"] == sampled["diverged_at_s"]
    short = summarise(simulate(unstable(content, 0.5)), 0, "horizon").to_json()
    assert short["final_state_norm"] < GROWTH * short["initial_state_norm"]
    assert (short["exit"]["status"], short["diverged_at_s"]) == (0, None)
