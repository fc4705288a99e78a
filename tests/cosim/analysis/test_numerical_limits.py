"""Numerical limits and divergence: defined behaviour at each, and no false violation."""

import json
from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.replay import replay
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.summary_model import ClaimVerdict
from cosim.record.divergence import GROWTH, Divergence, divergence
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import run_continuous, summary
from cosim.simulation.virtual_time import simulate
from netem.core.errors import CallerError, ExitStatus
from noack.core.linear_systems import Matrix, Vector
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate


def scenario(content: dict[str, Any], rate_hz: float = 100.0, **settings: Any) -> Scenario:
    """The small scenario; a double underscore stands for the dot of a key."""
    content["plant"]["rate_hz"] = rate_hz
    content["controller"] = {"rate_hz": rate_hz}
    for key, value in settings.items():
        section = content
        *path, last = key.split("__")
        for part in path:
            section = section.setdefault(part, {})
        section[last] = value
    return resolve(validate(content, "here"))


def plant(A: Any, B: Any, gain: Any, factor: float = 1.02) -> dict[str, Any]:
    """A model, and a slightly faster plant."""
    A, B = np.array(A, dtype=float), np.array(B, dtype=float)
    return {
        "model": {"A": A.tolist(), "B": B.tolist(), "gain": gain, "allow_unstable": True},
        "plant__initial_state": [1.0] * len(A),
        "plant__draw": "given",
        "plant__A": (factor * A).tolist(),
        "plant__B": B.tolist(),
    }


def require_sound(record: RunRecord, status: ExitStatus = ExitStatus.OK) -> dict[str, Any]:
    """Replay, summary and claims of a run: bit-exact, valid JSON, and no false violation."""
    summarised = summarise_loop(record, 0, "horizon").to_json()
    json.dumps(summarised, allow_nan=False)
    assert summarised["exit"]["status"] == status, summarised["exit"]
    assert replay(record).bit_exact is True
    with np.errstate(all="ignore"):
        claims = RunClaims(record).evaluate()
    assert claims
    assert [c for c in claims if c.verdict is ClaimVerdict.VIOLATED] == []
    return summarised


@pytest.mark.parametrize(
    "trigger",
    [
        {"beta": 1e-310, "alpha_per_s": 0.25},
        {"beta": 0.5, "alpha_per_s": 1e300},
        {"beta": 5e-324, "alpha_per_s": 5e-324},
    ],
)
def test_a_threshold_that_underflows_makes_every_error_an_event(
    content: dict[str, Any], trigger: dict[str, float]
) -> None:
    settings = plant([[0.0, 1.0], [0.0, 0.0]], [[0], [1]], [[-1.0, -1.7]], 1.1)
    record = simulate(scenario(content, trigger=trigger, horizon_s=3.0, **settings))
    require_sound(record)
    rows = record["sensor_measurement"][1:]
    late = rows[rows["threshold"] < 1e-300]
    assert len(late) > 100
    np.testing.assert_array_equal(late["event"] >= 0, late["compared"] > late["threshold"])
    # An error of exactly 0 is not an event: it never exceeds a threshold of exactly 0.
    assert not (late["event"] >= 0)[late["compared"] == 0].any()


STIFF = np.diag([-1e6, -1e3, -1.0, -1e-3])
FAST: dict[str, Any] = {"horizon_s": 0.2, "trigger": {"beta": 1e-3, "alpha_per_s": 0.25}}
SLOW = {"rate_hz": 1e-4, "horizon_s": 1e7, "trigger": {"beta": 0.1, "alpha_per_s": 1e-6}}


def of_size(size: float) -> dict[str, Any]:
    """A loop whose state and threshold have a magnitude."""
    return plant([[0.0, 1.0], [0.1, 0.0]], [[0], [1]], [[-1.0, -1.7]], 1.1) | {
        "plant__initial_state": [size, 0.0],
        "trigger": {"beta": max(0.1 * size, 5e-324), "alpha_per_s": 0.25},
    }


LOOPS = {
    "stiff": FAST | plant(STIFF, [[1.0]] * 4, [[0.0, 0.0, -0.1, 0.0]]),
    "defective": FAST | plant(-np.eye(3) + np.eye(3, k=1), [[0], [0], [1]], [[0.0, 0.0, 0.0]]),
    "badly scaled": FAST | plant([[-1.0, 1e12], [0.0, -2.0]], [[0], [1e-12]], [[0.0, -1.0]]),
    "far from normal": FAST | plant(-np.eye(20) + 10 * np.eye(20, k=1), [[0.0]] * 19 + [[1.0]], [[0.0] * 20]),
    "the longest horizon": SLOW | plant([[-1e-5]], [[1e-5]], [[-0.5]]),
    "huge": of_size(1e300),
    "large": of_size(1e150),
    "small": of_size(1e-160),
    "subnormal": of_size(5e-324),
    "a negative zero": {"plant__initial_state": [-0.0, 5e-324]},
    "both subnormal": {"plant__initial_state": [-5e-324, -1e-310]},
}


@pytest.mark.parametrize("name", LOOPS)
def test_unusual_loops_are_judged_and_replayed(content: dict[str, Any], name: str) -> None:
    resolved = scenario(content, **LOOPS[name])
    record = simulate(resolved)
    x0 = np.array(resolved.plant.initial_state)
    assert record["sensor_measurement"]["x"][0].tobytes() == x0.tobytes()
    assert require_sound(record)["reached_s"] == resolved.horizon_s


def test_a_loop_that_overflows_is_refused_or_has_diverged(content: dict[str, Any]) -> None:
    resolved = scenario(content, 20.0, horizon_s=20.0, **plant([[50.0]], [[1.0]], [[-0.1]]))
    summarised = require_sound(simulate(resolved), ExitStatus.FAILED)
    assert 10 < summarised["diverged_at_s"] < 20
    assert summarised["exit"]["reason"].startswith("diverged: x is not finite at")
    with pytest.raises(CallerError, match="take one step to infinity"):
        simulate(scenario(content, **plant([[-1.0]], [[1.0]], [[1e308]])))


def test_a_non_finite_input_is_not_applied(content: dict[str, Any]) -> None:
    resolved = scenario(
        content,
        **plant([[-1.0]], [[0.0]], [[-1e300]]) | {"plant__initial_state": [1e10]},
        trigger={"beta": 1e9, "alpha_per_s": 0.25},
    )
    record = simulate(resolved)
    sent = ~np.isfinite(record["controller_step"]["u"]).all(axis=1)
    assert sent.sum() > 50
    # The plant rejects non-finite inputs and holds the applied one; here there is none.
    assert np.isfinite(record["plant_step"]["u"]).all()
    assert np.isfinite(record["plant_step"]["x"]).all()
    summarised = summarise_loop(record, 0, "horizon").to_json()
    assert summarised["rejected_datagrams"]["plant"]["not_finite"] == sent.sum()


# --- a diverging run is not a disturbed, saturated, short or oscillating one ----------------------


T_S = np.linspace(0.0, 10.0, 1001)


def loop(content: dict[str, Any], **plant: Any) -> Scenario:
    content["plant"] |= plant
    return resolve(validate(content, "test"))


def at_0_unless(condition: Any) -> Matrix:
    return np.stack([np.where(condition, 1.0, 0.0), np.zeros_like(T_S)], axis=1)


def exponential(rate_per_s: float) -> Matrix:
    return np.exp(rate_per_s * T_S)[:, None] * [1.0, 0.5]


def diverged(x: Matrix, scenarios: list[Scenario]) -> Divergence | None:
    """The result must not depend on the parts in which the samples are read."""
    divergences = [
        divergence(zip(np.split(T_S, cuts), np.split(x, cuts), strict=True), len(T_S), scenarios)
        for cuts in ([], [50, 700, 705])
    ]
    assert divergences[0] == divergences[1]
    return divergences[0]


@pytest.mark.parametrize("rate_per_s", [1.0, 4.64, 30.0])
def test_an_unstable_loop_has_diverged(content: dict[str, Any], rate_per_s: float) -> None:
    result = diverged(exponential(rate_per_s), [loop(content)])
    assert result is not None
    assert 0 < result.at_s < 10
    assert "still growing at the end" in result.text
    assert "\n" not in result.text
    x = exponential(-rate_per_s)
    x[300:, 1] = np.inf
    result = diverged(x, [loop(content)])
    assert result is not None
    assert (result.at_s, result.text) == (3.0, "diverged: x is not finite at 3 s")


def shapes() -> dict[str, Matrix]:
    rng = np.random.default_rng(0)
    ones, wave = np.ones_like(T_S), np.sin(3 * T_S)
    rows: dict[str, Vector] = {
        "stable": np.exp(-T_S),
        "slowly unstable, so that the run is short": np.exp(0.6 * T_S),
        "an overshoot": 1e-3 + 1e6 * T_S * np.exp(-3 * T_S),
        "a limit cycle from next to nothing": 1e-9 + np.minimum(np.exp(6 * T_S - 30), 1) * wave,
        "saturated far away": 1e-6 + 1e5 * np.minimum(T_S / 5, 1),
        "noise": rng.normal(size=len(T_S)),
        "at rest": 0 * ones,
    }
    return {name: values[:, None] * [1.0, 0.1] for name, values in rows.items()}


@pytest.mark.parametrize("name", shapes())
def test_a_bounded_run_is_not_reported_as_diverged(content: dict[str, Any], name: str) -> None:
    assert diverged(shapes()[name], [loop(content)]) is None


def test_a_disturbance_or_set_point_sets_the_scale_of_the_state(content: dict[str, Any]) -> None:
    content["trigger"]["beta"] = 1e-9
    late = at_0_unless(T_S >= 9.5) + 1e-12
    plain = loop(content)
    # nothing in the run explains a state of this size
    assert diverged(late, [plain]) is not None
    step = {"kind": "step", "amplitude": [1.0], "from_s": 0.0}
    assert diverged(late, [loop(content, disturbances=[step])]) is None
    controller = plain.controller.model_copy(update={"setpoint": (1.0, 0.0)})
    assert diverged(late, [plain, plain.model_copy(update={"controller": controller})]) is None


def unstable(content: dict[str, Any], horizon_s: float) -> Scenario:
    """The sign convention of Matlab, on purpose: A + BK has the eigenvalue 4.64."""
    content["model"] = {
        "A": [[0.0, 1.0], [3.0, -0.5]], "B": [[0.0], [1.0]], "gain": [[6.16, 3.17]],
        "allow_unstable": True,
    }  # fmt: skip
    return loop(content | {"horizon_s": horizon_s}, draw="nominal", initial_state=[0.1, 0.0])


def test_a_simulated_run_that_diverges_fails(content: dict[str, Any]) -> None:
    resolved = unstable(content, 8.0)
    sampled = summarise_loop(simulate(resolved), 0, "horizon").to_json()
    continuous = summary(run_continuous(resolved), resolved).to_json()
    for summarised in (sampled, continuous):
        assert summarised["exit"]["status"] == 1
        assert summarised["exit"]["reason"].startswith("diverged: ‖x‖ passed ")
        assert 1e6 < summarised["final_state_norm"] < np.inf
    assert sampled["diverged_at_s"] == pytest.approx(continuous["diverged_at_s"], abs=0.1)
    stopped = summarise_loop(simulate(resolved), 130, "stopped by the user (SIGINT)").to_json()
    assert stopped["exit"] == {"status": 130, "reason": "stopped by the user (SIGINT)"}
    assert stopped["diverged_at_s"] == sampled["diverged_at_s"]
    short = summarise_loop(simulate(unstable(content, 0.5)), 0, "horizon").to_json()
    assert short["final_state_norm"] < GROWTH * short["initial_state_norm"]
    assert (short["exit"]["status"], short["diverged_at_s"]) == (0, None)
