"""Real processes that serve several loops: on a bottleneck, and of different plants."""

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_events import updates_in
from cosim.record.run_record import RunRecord, load_record, load_run
from noack.protocol.record_tables import NETEM_PACKET, PLANT_STEP, Fate
from noack.scenario.scenario import phases_ns
from tests.integration import conftest as live
from tests.integration.conftest import noack_command

HEAD = """
name = "three"
horizon_s = 8.0
speed = 2.0
recovery = { rejoin_within_s = 0 }

"""
REST = """
impairments = [{ kind = "rate", rate_bps = 20_000, queue = 2 }]

[[loops]]
name = "good"
count = 2

[[loops]]
name = "wild"
plant = { draw = "given", A = [[3.0, 0.0], [0.0, 3.0]], B = [[0.0], [0.0]] }
"""
NAMES = ("good-1", "good-2", "wild")


def record_of(run: live.Finished, name: str) -> RunRecord:
    return load_record(run.run_dir, name)


def loop_of(run: live.Finished, name: str) -> dict[str, Any]:
    (found,) = [one for one in run.summary["loops"] if one["name"] == name]
    return dict(found)


def test_one_loop_diverges_and_the_others_go_on(tmp_path: Path) -> None:
    scenario = tmp_path / "three.toml"
    scenario.write_text(HEAD + live.PENDULUM + REST)
    with live.begun(tmp_path) as start:
        finished = start(command=("run", str(scenario), "--live")).finish()
    assert finished.status == 1
    assert finished.summary["exit"]["reason"].startswith("1 of 3 loops failed (wild diverged at ")
    assert loop_of(finished, "wild")["diverged_at_s"] > 1.0
    assert "wild: diverges from " in finished.stderr
    network = load_run(finished.run_dir).network
    assert replay(network).bit_exact
    for name in NAMES:
        record = record_of(finished, name)
        assert np.array_equal(record[PLANT_STEP]["sequence"], np.arange(401))
        assert replay(record).bit_exact
        assert loop_of(finished, name)["longest_loss_burst"] <= 2
        said = [one["t_ns"] for one in record.notices if one["level"] == "diverges"]
        assert len(said) == (name == "wild")
        assert all(1e9 < t_ns < 8e9 for t_ns in said)
    packets, phases = network[NETEM_PACKET], phases_ns(network.scenario)
    assert (packets["fate"] == Fate.OVERFLOWED).any()
    for flow, phase_ns in enumerate(phases):
        of_one = packets[packets["flow"] == flow]
        assert of_one["consecutive_losses"].max() <= 2
        # An update's time is that of its loop; the network records the time of the run.
        assert (of_one["now_ns"] - updates_in(of_one)[2] >= phase_ns).all()
    for name in NAMES[:2]:
        assert loop_of(finished, name)["exit"] == {"status": 0, "reason": "horizon"}
        assert np.linalg.norm(record_of(finished, name)[PLANT_STEP]["x"][-1]) < 0.1


DIFFERENT = ("lane", "pendulum-1", "pendulum-2", "mass")
SIZES = {"lane": 4, "pendulum-1": 2, "pendulum-2": 2, "mass": 2}
STEPS = {"lane": 1501, "pendulum-1": 301, "pendulum-2": 301, "mass": 1501}


def noack(*arguments: str, folder: Path) -> str:
    done = subprocess.run(
        noack_command(*arguments), check=True, capture_output=True, text=True, cwd=folder
    )
    return done.stdout


@pytest.fixture(scope="module")
def different(tmp_path_factory: pytest.TempPathFactory) -> live.Finished:
    """With the live recording, and a change of settings on the way."""
    change = "changes=[{ at_s = 1.5, set = { mansd = 2 } }]"
    settings = (*live.settings(horizon_s=3.0), "--set", change)
    with live.begun(tmp_path_factory.mktemp("different")) as start:
        return start(*settings, command=("run", "different_loops")).finish()


def test_all_loops_reach_the_horizon_at_their_rates_and_are_replayed(
    different: live.Finished,
) -> None:
    assert different.status == 0, different.stderr
    run = load_run(different.run_dir)
    assert tuple(run.names) == DIFFERENT
    assert replay(run.network).bit_exact
    for name, record in zip(DIFFERENT, run.loops, strict=True):
        assert replay(record).bit_exact
        steps = record["plant_step"]
        assert (len(steps), steps["x"].shape[1]) == (STEPS[name], SIZES[name])
        assert len(record["sensor_setting"]) == 1
    assert all(loop["exit"]["status"] == 0 for loop in different.summary["loops"])


def test_export_and_archive_have_every_loop(different: live.Finished, tmp_path: Path) -> None:
    noack("export", str(different.run_dir), "--format", "csv", "--out", str(tmp_path / "csv"),
          folder=tmp_path)  # fmt: skip
    for name in DIFFERENT:
        header = (tmp_path / "csv" / name / "samples.csv").read_text().splitlines()[0]
        assert header.count("x_c_") in (0, SIZES[name])
    noack("archive", str(different.run_dir), "--out", str(tmp_path / "a.zip"), folder=tmp_path)
    noack("reproduce", "a.zip", folder=tmp_path)
