"""Processes that help with the end of a long run: the results are those without them."""

import json
import os
import time
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from threading import Event

import pytest

from cosim.analysis.replay import replay
from cosim.live import end_helpers, finalize
from cosim.live.end_helpers import EndHelpers, PreparedEnding
from cosim.live.finalize import ReplayBeside
from cosim.live.simulated_run import simulate_run
from cosim.record.run_directory import (
    SCENARIO_FILE,
    SUMMARY_FILE,
    RunEnding,
    write_environment,
    write_scenario,
)
from cosim.record.run_record import load_record, write_run
from cosim.shipped_files import find_shipped
from cosim.simulation.virtual_time import simulate
from noack.core.errors import ExitStatus
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.summaries import alone


@pytest.fixture
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    scenario = find_shipped("double_integrator", "scenarios")
    record = simulate(resolve(load(scenario, ["horizon_s=1"])))
    record[PLANT_STEP]["u"][9, 0] += 1.0
    write_scenario(record.scenario, tmp_path)
    write_environment(tmp_path, "live")
    write_run(alone(record), tmp_path)
    monkeypatch.setattr(end_helpers, "_MANY_STEPS", 10)
    monkeypatch.setattr(end_helpers, "cores", lambda: 2)
    return tmp_path


@pytest.fixture
def many_loops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of more loops than are prepared at once, without a summary."""
    monkeypatch.setattr(end_helpers, "_MANY_STEPS", 10)
    monkeypatch.setattr(end_helpers, "cores", lambda: 2)
    scenario = load(find_shipped("shared_bottleneck", "scenarios"), ["horizon_s=1"])
    assert scenario.loops is not None
    loops = (scenario.loops[0].model_copy(update={"count": 20}),)
    return simulate_run(scenario.model_copy(update={"loops": loops}), tmp_path).run_dir


@pytest.mark.parametrize("is_killed", [False, True])
def test_a_prepared_end_is_that_of_a_run_without_preparation(
    many_loops: Path, monkeypatch: pytest.MonkeyPatch, *, is_killed: bool
) -> None:
    given = (many_loops, 0, ExitStatus.OK, "horizon")
    expected = finalize.finalize(RunEnding(*given), report=False, view=False).summary
    helpers = EndHelpers(load(many_loops / SCENARIO_FILE))
    helpers.prepare(many_loops)
    for thread in helpers._threads:
        thread.join()
    assert helpers.expectations(range(20)) is not None
    monkeypatch.setattr(finalize, "_expectations", _killed)
    if is_killed:
        assert helpers.submit(os.getpid).result() != os.getpid()
        with pytest.raises(BrokenProcessPool):
            helpers.submit(os._exit, 1).result()
    ending = PreparedEnding(*given, helpers=helpers)
    assert finalize.finalize(ending, report=False, view=False).summary == expected


def test_the_end_does_not_wait_for_a_preparation_that_gets_no_time(
    many_loops: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = Event()

    def endless(helpers: EndHelpers, *_: object) -> None:
        waiting = helpers.submit(time.sleep, 1e6)
        begun.set()
        waiting.result()

    monkeypatch.setattr(EndHelpers, "_prepare_loops", endless)
    monkeypatch.setattr(end_helpers, "_GRACE_S", 0.0)
    helpers = EndHelpers(load(many_loops / SCENARIO_FILE))
    helpers.prepare(many_loops)
    begun.wait()
    ending = PreparedEnding(many_loops, 0, ExitStatus.OK, "horizon", helpers=helpers)
    assert len(finalize.finalize(ending, report=False, view=False).summary.loops) == 20


def _killed(*_: object) -> None:
    raise MemoryError


@pytest.mark.parametrize("part", [ReplayBeside.part, _killed])
def test_the_replay_beside_is_that_of_this_process_and_is_not_lost(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch, part: Callable[..., object]
) -> None:
    found = []

    def told(self: ReplayBeside) -> object:
        try:
            found.append(part(self))
        except MemoryError:
            found.append(None)
        return found[-1]

    monkeypatch.setattr(ReplayBeside, "part", told)
    finalize.finalize(RunEnding(run_dir, 0, ExitStatus.OK, "horizon"), report=False)
    stored = json.loads((run_dir / SUMMARY_FILE).read_text())["loops"][0]["replay"]
    assert stored["first_difference"]["row"] == 9
    assert stored == replay(load_record(run_dir)).verdict().model_dump()
    assert len(found) == 1
    assert (found[0] is None) == (part is _killed)
