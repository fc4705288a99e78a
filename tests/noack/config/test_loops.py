"""The loops of a scenario: what they inherit, and what they draw; mistakes: mistakes.txt."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario, loops_of, phases_ns
from noack.config.scenario_file import completed, dumps, load, validate
from noack.core.errors import CallerError


def with_loops(content: dict[str, Any], *loops: dict[str, Any]) -> Scenario:
    return validate(content | {"loops": list(loops)}, "here")


def test_a_loop_is_the_top_level_with_its_own_keys(content: dict[str, Any]) -> None:
    periodic = {"policy": "periodic", "period_s": 0.1}
    scenario = with_loops(
        content,
        {"name": "one"},
        {"name": "other", "count": 10, "mode": "zoh", "plant": {"initial_state": [3.0, 4.0]}},
        {"name": "third", "trigger": periodic},
    )
    loops = loops_of(scenario)
    assert [one.name for one in loops[:3]] == ["one", "other-01", "other-02"]
    assert (loops[10].name, loops[11].name, len(loops)) == ("other-10", "third", 12)
    alone = validate(content, "here")
    assert loops_of(alone) == (alone,)
    assert loops[0] == alone.model_copy(update={"name": "one"})
    assert loops[5].plant.initial_state == (3.0, 4.0)
    assert loops[5].plant.rate_hz == alone.plant.rate_hz
    assert (loops[5].mode, loops[11].mode) == ("zoh", alone.mode)
    assert loops[11].trigger.model_dump(exclude_none=True) == periodic
    assert loops[5].network == alone.network


def test_each_loop_draws_its_own_plant_state_and_phase(content: dict[str, Any]) -> None:
    content["plant"] |= {
        "draw": "uniform", "uncertainty_A": [[0.1, 0.1], [0.1, 0.1]],
        "initial_state_halfwidth": [1.0, 1.0],
    }  # fmt: skip
    count = 200
    scenario = with_loops(content, {"name": "a", "count": count})
    drawn = [loop_of(resolve(one)) for one in loops_of(scenario)]
    assert len({one.A.tobytes() for one in drawn}) == count
    assert len({one.x0.tobytes() for one in drawn}) == count
    phases, period_ns = phases_ns(scenario), scenario.timing.measurement_period_ns
    assert phases[0] == 0
    assert 0 <= min(phases) <= max(phases) < period_ns
    # Uniform phases: the mean of 200 is within 5 standard errors of one half.
    assert abs(np.mean(phases[1:]) / period_ns - 0.5) < 5 * 12**-0.5 / (count - 1) ** 0.5
    # Those of a periodic trigger are within its own period.
    periodic = {"name": "a", "count": count, "trigger": {"policy": "periodic", "period_s": 0.1}}
    wide = phases_ns(with_loops(content, periodic))
    assert 80_000_000 < max(wide) < 100_000_000
    # They are functions of the run's seeds and the loop's number.
    fewer = with_loops(content, {"name": "b", "count": 3}, {"name": "c"})
    assert phases_ns(fewer) == phases[:4]
    assert [one.seeds for one in loops_of(fewer)] == [one.seeds for one in loops_of(scenario)[:4]]
    other = with_loops(content | {"seeds": {"initial_state": 1}}, {"name": "a", "count": 3})
    assert phases_ns(other)[1:] != phases[1:3]


def test_an_entry_may_set_seed_and_phase_of_its_loops(content: dict[str, Any]) -> None:
    scenario = with_loops(
        content, {"name": "a", "count": 3, "phase": 0.25, "seeds": {"disturbance": 7}}
    )
    assert {one.seeds.disturbance for one in loops_of(scenario)} == {7}
    assert len({one.seeds.noise for one in loops_of(scenario)}) == 3
    assert set(phases_ns(scenario)) == {scenario.timing.measurement_period_ns // 4}


def test_the_file_of_a_loop_is_found_beside_the_scenario(
    content: dict[str, Any], tmp_path: Path
) -> None:
    source = "class Mine:\n    pass\n"
    (tmp_path / "mine.py").write_text(source)
    np.savez(tmp_path / "true.npz", A=[[0.0, 1.0], [0.5, 0.0]], B=[[0.0], [1.0]])
    own = {"policy": "python", "file": "mine.py", "name": "Mine"}
    given = {"draw": "given", "file": "true.npz"}
    loops = [{"name": "a", "trigger": own}, {"name": "b", "plant": given}]
    scenario = completed(content | {"loops": loops}, tmp_path / "s.toml")
    trigger = loops_of(scenario)[0].trigger
    assert trigger.file == str(tmp_path / "mine.py")
    assert trigger.sha256 == hashlib.sha256(source.encode()).hexdigest()
    assert loops_of(scenario)[1].plant.A == ((0.0, 1.0), (0.5, 0.0))
    (tmp_path / "again.toml").write_text(dumps(scenario))
    assert load(tmp_path / "again.toml") == scenario


def test_a_file_is_not_read_where_tables_are_validated(content: dict[str, Any]) -> None:
    with pytest.raises(CallerError, match="it is read where a scenario file is loaded"):
        with_loops(content, {"name": "a", "scenario": "other.toml"})


def test_only_single_loops_are_resolved(content: dict[str, Any]) -> None:
    with pytest.raises(CallerError, match="it has 2 loops; give a scenario of one loop"):
        resolve(with_loops(content, {"name": "a"}, {"name": "b"}))
