"""Loops of different plants, sizes and rates in real processes, from the command line."""

import json
import subprocess
from pathlib import Path

import pytest

from cosim.analysis.replay import replay
from cosim.record.run_record import load_run
from tests.integration import conftest as live
from tests.integration.conftest import noack_command

NAMES = ("lane", "pendulum-1", "pendulum-2", "mass")
SIZES = {"lane": 4, "pendulum-1": 2, "pendulum-2": 2, "mass": 2}
STEPS = {"lane": 1501, "pendulum-1": 301, "pendulum-2": 301, "mass": 1501}


def noack(*arguments: str, folder: Path) -> str:
    done = subprocess.run(
        noack_command(*arguments), check=True, capture_output=True, text=True, cwd=folder
    )
    return done.stdout


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> live.Finished:
    """With the live recording, and a change of settings on the way."""
    change = "changes=[{ at_s = 1.5, set = { mansd = 2 } }]"
    settings = (*live.settings(horizon_s=3.0), "--set", change)
    with live.begun(tmp_path_factory.mktemp("different")) as start:
        return start(*settings, command=("run", "different_loops")).finish()


def test_all_loops_reach_the_horizon_at_their_rates(finished: live.Finished) -> None:
    assert finished.status == 0, finished.stderr
    run = load_run(finished.run_dir)
    assert tuple(run.names) == NAMES
    for name, record in zip(NAMES, run.loops, strict=True):
        steps = record["plant_step"]
        assert (len(steps), steps["x"].shape[1]) == (STEPS[name], SIZES[name])
        assert len(record["sensor_setting"]) == 1
    assert all(loop["exit"]["status"] == 0 for loop in finished.summary["loops"])


def test_the_run_is_replayed_bit_by_bit(finished: live.Finished) -> None:
    run = load_run(finished.run_dir)
    assert replay(run.network).bit_exact
    for record in run.loops:
        assert replay(record).bit_exact
    shown = noack("replay", str(finished.run_dir), folder=finished.run_dir)
    assert "bit-exact" in shown


def test_export_and_archive_have_every_loop(finished: live.Finished, tmp_path: Path) -> None:
    noack("export", str(finished.run_dir), "--format", "csv", "--out", str(tmp_path / "csv"),
          folder=tmp_path)  # fmt: skip
    for name in NAMES:
        header = (tmp_path / "csv" / name / "samples.csv").read_text().splitlines()[0]
        assert header.count("x_c_") in (0, SIZES[name])
    noack("archive", str(finished.run_dir), "--out", str(tmp_path / "a.zip"), folder=tmp_path)
    noack("reproduce", "a.zip", folder=tmp_path)


def test_check_and_simulate(tmp_path: Path) -> None:
    checked = noack("check", "different_loops", folder=tmp_path)
    assert "[loops.scenario.plant]" in checked
    done = json.loads(
        noack("simulate", "different_loops", "--json", "--no-report", "--set", "horizon_s=2.0",
              folder=tmp_path)
    )  # fmt: skip
    assert [loop["name"] for loop in done["loops"]] == [*NAMES]
