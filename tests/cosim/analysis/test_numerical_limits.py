"""Numerical limits: defined behaviour at each, and no false violation."""

import json
from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.replay import replay
from cosim.analysis.run_summary import summarise
from cosim.analysis.summary_model import ClaimVerdict
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError, ExitStatus
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
    found = summarise(record, 0, "horizon").to_json()
    json.dumps(found, allow_nan=False)
    assert found["exit"]["status"] == status, found["exit"]
    assert replay(record).bit_exact is True
    with np.errstate(all="ignore"):
        claims = ClaimEvaluation(record).judge()
    assert claims
    assert [c for c in claims if c.verdict is ClaimVerdict.VIOLATED] == []
    return found


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
    "far from normal": FAST
    | plant(-np.eye(20) + 10 * np.eye(20, k=1), [[0.0]] * 19 + [[1.0]], [[0.0] * 20]),
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
    found = require_sound(simulate(resolved), ExitStatus.FAILED)
    assert 10 < found["diverged_at_s"] < 20
    assert found["exit"]["reason"].startswith("diverged: x is not finite at")
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
    found = summarise(record, 0, "horizon").to_json()
    assert found["rejected_datagrams"]["plant"]["not_finite"] == sent.sum()
