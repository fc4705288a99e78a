"""Runs that a program starts, opens and evaluates."""

import gc
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import noack


def test_a_run_gives_its_results(simulated: noack.Run) -> None:
    assert simulated.ok
    assert simulated.reason == "horizon"
    written = json.loads((simulated.directory / "summary.json").read_text())
    assert simulated.summary.to_json() == written
    (loop,) = simulated.summary.loops
    assert simulated.claims == loop.claims != []
    assert simulated.scenario.plant.draw == "given"
    for shown in (repr(simulated), simulated._repr_html_()):
        assert "own_system" in shown
        assert str(loop.events) in shown
    assert len(repr(simulated).splitlines()) < 10


def test_a_run_of_several_loops_has_each_loop_as_a_run() -> None:
    network = {"network.loss.probability": 0.5, "horizon_s": 1.0}
    loops = [{"name": "fast", "count": 2}, {"name": "held", "mode": "zoh"}]
    run = noack.simulate(noack.load("double_integrator", network | {"loops": loops}))
    assert run.ok
    assert "3 loops" in repr(run)
    assert list(run.loops) == ["fast-1", "fast-2", "held"]
    events = {name: one.summary.loops[0].events for name, one in run.loops.items()}
    assert events == {one.name: one.events for one in run.summary.loops}
    assert sum(events.values()) == len(run.table("netem_packet"))
    assert run.claims == [claim for one in run.loops.values() for claim in one.claims]
    steps = run.table("plant_step")["loop"].to_pylist()
    assert steps == sorted(steps)
    assert set(steps) == {0, 1, 2}
    assert run.loops["fast-2"].table("plant_step").num_rows == steps.count(1)
    held = run.loops["held"]
    assert held.scenario.mode == "zoh"
    assert len(held.events()) == events["held"]
    assert list(held.loops) == ["held"]
    assert isinstance(run.plot("loops"), Figure)
    with pytest.raises(
        noack.NoackError, match=r"3 loops: take one .* they are fast-1, fast-2, held"
    ):
        run.samples()


def test_a_run_is_replayed(simulated: noack.Run) -> None:
    assert simulated.replay().bit_exact
    assert simulated.fidelity().explained


def test_a_temporary_run_exists_as_long_as_its_object() -> None:
    run = noack.simulate(noack.load("double_integrator", {"horizon_s": 0.1}))
    folder = run.directory
    assert folder.is_dir()
    assert not (folder / "recording.rrd").exists()
    del run
    gc.collect()
    assert not folder.parent.exists()


def test_a_run_of_the_api_has_an_ordinary_run_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scenario: noack.Scenario
) -> None:
    run = noack.simulate(scenario, runs=tmp_path / "runs")
    assert (run.directory / "recording.rrd").is_file()
    monkeypatch.chdir(tmp_path)
    again = noack.open_run()
    assert again.directory.samefile(run.directory)
    assert again.summary == run.summary
    assert again.report() == again.directory / "report.html"


def test_an_interrupted_live_run_is_returned() -> None:
    program = (
        "import noack\n"
        "scenario = noack.load('double_integrator', {'horizon_s': 10.0})\n"
        "run = noack.run(scenario, progress=True)\n"
        "print(run.ok, run.reason, run.table('plant_step').num_rows > 100)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"FORCE_COLOR": "1", "TERM": "dumb"},  # no progress is printed to a pipe
    ) as process:  # fmt: skip
        assert process.stderr is not None
        assert any("/10 s" in line for line in process.stderr)
        process.send_signal(signal.SIGINT)
        stdout, _ = process.communicate(timeout=100)
    assert stdout.split("\n")[0] == "False stopped by the user (SIGINT) True"
    assert process.returncode == 0


def test_a_live_run_needs_the_main_thread(scenario: noack.Scenario) -> None:
    caught: list[noack.NoackError] = []

    def start() -> None:
        with pytest.raises(noack.NoackError, match="main thread") as error:
            noack.run(scenario)
        caught.append(error.value)

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    assert caught


def test_an_invalid_run_gives_one_line(tmp_path: Path) -> None:
    with pytest.raises(noack.NoackError, match="not a run directory"):
        noack.open_run(tmp_path)


@pytest.mark.parametrize(
    "name", ["states", "errors", "state-norm", "input", "inter-event", "losses"]
)
def test_a_figure_is_shown_by_a_notebook(simulated: noack.Run, name: str) -> None:
    figure = simulated.plot(name)
    assert isinstance(figure, Figure)
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]


def test_an_unknown_figure_or_table_gives_one_line(simulated: noack.Run) -> None:
    with pytest.raises(noack.NoackError, match=r'"lateness": no such figure .* it has states, '):
        simulated.plot("lateness")
    with pytest.raises(noack.NoackError, match='"plant": the record has no such table; it has'):
        simulated.table("plant")


def test_a_diverging_run_gives_its_results() -> None:
    run = noack.simulate(
        noack.from_system(
            ([[100.0]], [[1.0]]), [[-150.0]], [1.0],
            plant=([[300.0]], [[1.0]]), settings={"horizon_s": 5.0},
        )
    )  # fmt: skip
    assert not run.ok
    assert "diverged" in run.reason
    assert not np.isfinite(run.table("plant_step")["x_1"].to_numpy()).all()
    assert isinstance(run.plot(), Figure)
