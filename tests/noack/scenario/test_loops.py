"""The loops of a scenario, also of files of their own: what they inherit and what they draw."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from netem.core.errors import CallerError
from noack.scenario.resolution import ResolvedRun, loop_of, resolve
from noack.scenario.scenario import Scenario, loop_names, loops_of
from noack.scenario.scenario_file import load, toml_text, validate
from tests.helpers.approved import compare_lines, lines_of_error


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
    assert [loop.name for loop in loops[:3]] == ["one", "other-01", "other-02"]
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
    drawn = [loop_of(resolve(loop)) for loop in loops_of(scenario)]
    assert len({system.A.tobytes() for system in drawn}) == count
    assert len({system.x0.tobytes() for system in drawn}) == count
    phases, period_ns = ResolvedRun(scenario).phases_ns, scenario.timing.measurement_period_ns
    assert phases[0] == 0
    assert 0 <= min(phases) <= max(phases) < period_ns
    # Uniform phases: the mean of 200 is within 5 standard errors of one half.
    assert abs(np.mean(phases[1:]) / period_ns - 0.5) < 5 * 12**-0.5 / (count - 1) ** 0.5
    # Those of a periodic trigger are within its own period.
    periodic = {"name": "a", "count": count, "trigger": {"policy": "periodic", "period_s": 0.1}}
    wide = ResolvedRun(with_loops(content, periodic)).phases_ns
    assert 80_000_000 < max(wide) < 100_000_000
    # They are functions of the run's seeds and the loop's number.
    fewer = with_loops(content, {"name": "b", "count": 3}, {"name": "c"})
    assert ResolvedRun(fewer).phases_ns == phases[:4]
    assert [loop.seeds for loop in loops_of(fewer)] == [loop.seeds for loop in loops_of(scenario)[:4]]
    other = with_loops(content | {"seeds": {"initial_state": 1}}, {"name": "a", "count": 3})
    assert ResolvedRun(other).phases_ns[1:] != phases[1:3]


def test_a_file_is_not_read_where_tables_are_validated(content: dict[str, Any]) -> None:
    with pytest.raises(CallerError, match="it is read where a scenario file is loaded"):
        with_loops(content, {"name": "a", "scenario": "other.toml"})


PARTS = ("mode", "model", "plant", "trigger", "observer", "controller")
OTHER = {
    "name": "other",
    "horizon_s": 3.0,
    "speed": 2.0,
    "mode": "zoh",
    "model": {"A": [[-1.0]], "B": [[1.0]], "gain": [[-1.0]]},
    "plant": {"initial_state": [2.0], "rate_hz": 50.0},
    "trigger": {"policy": "periodic", "period_s": 0.1},
    "seeds": {"plant": 9},
    "ports": {"plant": 50_000},
}


def write(folder: Path, name: str, content: dict[str, Any]) -> Path:
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(toml_text(content))
    return path


def loaded(folder: Path, content: dict[str, Any], other: dict[str, Any], **entry: Any) -> Scenario:
    """The first loop is the top level, the second one has a file in another folder."""
    write(folder, "parts/other.toml", other)
    loops = [{"name": "a"}, {"name": "b", "scenario": "parts/other.toml", **entry}]
    return load(write(folder, "run.toml", content | {"loops": loops}))


def test_a_loop_is_that_of_its_file_on_the_network_of_the_run(
    content: dict[str, Any], tmp_path: Path
) -> None:
    scenario = loaded(tmp_path, content, OTHER)
    first, second = loops_of(scenario)
    alone = load(write(tmp_path, "alone.toml", OTHER | {"network": content["network"]}))
    for part in PARTS:
        assert getattr(second, part) == getattr(alone, part)
    assert second.network == first.network == scenario.network
    assert (second.horizon_s, second.speed) == (scenario.horizon_s, scenario.speed)
    assert (second.ports, second.seeds.loss) == (scenario.ports, scenario.seeds.loss)
    assert second.seeds.plant != 9  # drawn from the seeds of the run
    shared = {key: value for key, value in content.items() if key not in PARTS}
    entries = [{"name": name, "scenario": "parts/other.toml"} for name in "ab"]
    assert loops_of(load(write(tmp_path, "files.toml", shared | {"loops": entries})))[1] == second
    with pytest.raises(CallerError, match="model: missing"):
        load(write(tmp_path, "files.toml", shared | {"loops": [*entries, {"name": "c"}]}))


def test_keys_of_the_entry_change_the_file(content: dict[str, Any], tmp_path: Path) -> None:
    scenario = loaded(
        tmp_path, content, OTHER, count=2, mode="model",
        plant={"rate_hz": 100.0}, trigger={"period_s": 0.2},
        controller={"kind": "linear", "rate_hz": 25.0}, seeds={"plant": 3},
    )  # fmt: skip
    assert loop_names(scenario) == ["a", "b-1", "b-2"]
    loop = loops_of(scenario)[2]
    assert (loop.plant.rate_hz, loop.plant.initial_state) == (100.0, (2.0,))
    assert loop.trigger.model_dump(exclude_none=True) == {"policy": "periodic", "period_s": 0.2}
    assert (loop.controller.rate_hz, loop.mode, loop.seeds.plant) == (25.0, "model", 3)


def test_files_that_the_file_names_are_beside_it(content: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    np.savez(tmp_path / "parts/model.npz", A=[[-3.0]], B=[[1.0]], gain=[[-1.0]])
    (tmp_path / "parts/trigger.py").write_text("class Trigger: ...")
    own = {"policy": "python", "name": "Trigger", "file": "trigger.py"}
    other = OTHER | {"model": {"file": "model.npz"}, "trigger": own}
    elsewhere = own | {"file": "parts/trigger.py"}
    for entry in ({}, {"trigger": elsewhere}):
        loop = loops_of(loaded(tmp_path, content, other, **entry))[1]
        assert loop.model.A == ((-3.0,),)
        trigger: Any = loop.trigger
        assert trigger.file == str(tmp_path / "parts/trigger.py")
        assert len(trigger.sha256) == 64


def test_a_mistake_in_a_loops_file_gives_the_approved_lines(content: dict[str, Any], tmp_path: Path) -> None:
    def mistake(line: str) -> list[str]:
        name, other = json.loads(line)
        write(tmp_path, "parts/other.toml", OTHER | other)
        run = write(tmp_path, "run.toml", content | {"loops": [{"name": "b", "scenario": name}]})
        return lines_of_error(lambda: load(run), FOLDER=tmp_path)

    compare_lines(Path(__file__).with_name("loop_mistakes.txt"), mistake)
