"""Real processes that serve several loops, which share a bottleneck."""

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.analysis.summary_model import read_summary
from cosim.output.run_tables import network_rows
from cosim.record.run_events import updates_in
from cosim.record.run_record import RunRecord, load_record, load_run
from noack.protocol.record_tables import NETEM_PACKET, PLANT_STEP, Fate
from noack.scenario.scenario import phases_ns
from tests.integration import conftest as live
from tests.integration.test_restarts import kill

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


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scenario") / "three.toml"
    path.write_text(HEAD + live.PENDULUM + REST)
    return path


@pytest.fixture(scope="module")
def finished(scenario: Path, tmp_path_factory: pytest.TempPathFactory) -> live.Finished:
    with live.begun(tmp_path_factory.mktemp("shared")) as start:
        return start(command=("run", str(scenario), "--live")).finish()


def record_of(run: live.Finished, name: str) -> RunRecord:
    return load_record(run.run_dir, name)


def loop_of(run: live.Finished, name: str) -> dict[str, Any]:
    (found,) = [one for one in run.summary["loops"] if one["name"] == name]
    return dict(found)


def test_one_loop_diverges_and_the_others_go_on(finished: live.Finished) -> None:
    assert finished.status == 1
    assert finished.summary["exit"]["reason"].startswith("1 of 3 loops failed (wild diverged at ")
    assert loop_of(finished, "wild")["diverged_at_s"] > 1.0
    for name in NAMES:
        record = record_of(finished, name)
        assert record.count(PLANT_STEP) == 401
        assert np.array_equal(record[PLANT_STEP]["sequence"], np.arange(401))
    for name in NAMES[:2]:
        assert loop_of(finished, name)["exit"] == {"status": 0, "reason": "horizon"}
        assert np.linalg.norm(record_of(finished, name)[PLANT_STEP]["x"][-1]) < 0.1


def test_the_diverging_loop_is_named_during_the_run(finished: live.Finished) -> None:
    """In its own log only; its time is before the end."""
    said = {
        name: [one for one in record_of(finished, name).notices if one["level"] == "diverges"]
        for name in NAMES
    }
    assert [len(said[name]) for name in NAMES] == [0, 0, 1]
    assert 1e9 < said["wild"][0]["t_ns"] < 8e9
    assert "wild: diverges from " in finished.stderr


def test_the_loops_compete_for_the_bottleneck_and_the_guarantee_holds_for_each(
    finished: live.Finished,
) -> None:
    network = load_run(finished.run_dir).network
    packets = network[NETEM_PACKET]
    assert np.array_equal(np.unique(packets["flow"]), [0, 1, 2])
    assert (packets["fate"] == Fate.OVERFLOWED).any()
    for flow in range(3):
        assert packets["consecutive_losses"][packets["flow"] == flow].max() <= 2
    for name in NAMES:
        assert loop_of(finished, name)["longest_loss_burst"] <= 2
        assert record_of(finished, name).count(NETEM_PACKET) == (packets["flow"] == 0).sum()


def test_each_loop_and_the_network_are_replayed_bit_by_bit(finished: live.Finished) -> None:
    assert finished.summary["network"]["replay"]["bit_exact"] is True
    network = replay(load_run(finished.run_dir).network)
    assert network.bit_exact
    for name in NAMES:
        found = replay(record_of(finished, name))
        assert found.bit_exact, found


def test_the_summary_counts_the_missed_deadlines_of_all_loops(finished: live.Finished) -> None:
    steps = np.concatenate([record_of(finished, name)[PLANT_STEP] for name in NAMES])
    late_ns = steps["now_ns"] - steps["t_ns"]
    found = finished.summary["deadlines"]["plant"]
    assert (found["steps"], found["late_steps"]) == (3 * 401, (late_ns > 20_000_000).sum())
    assert found["max_us"] == pytest.approx(late_ns.max() / 1e3 / 2)  # twice as fast
    summary = read_summary(finished.summary)
    assert summary is not None
    rows = dict(network_rows(summary))
    assert (rows["deadlines missed"] == "none") == (
        not any(one["late_steps"] for one in finished.summary["deadlines"].values())
    )


def test_loops_begin_at_their_phases(finished: live.Finished) -> None:
    """An update's time is that of its loop; the network records the time of the run."""
    network = load_run(finished.run_dir).network
    phases, packets = phases_ns(network.scenario), network[NETEM_PACKET]
    assert len(set(phases)) == 3
    for flow, phase_ns in enumerate(phases):
        of_one = packets[packets["flow"] == flow]
        _, _, events_ns = updates_in(of_one)
        assert (of_one["now_ns"] - events_ns >= phase_ns).all()


def test_restarted_processes_serve_all_loops_again(scenario: Path, tmp_path: Path) -> None:
    with live.begun(tmp_path) as start:
        running = start(
            *live.settings(horizon_s=4000.0, recovery__rejoin_within_s=60),
            command=("run", str(scenario)),
        )
        running.wait_started()
        for role in ("sensor", "netem"):
            kill(running, role)
        running.process.send_signal(signal.SIGINT)
        run = running.finish()
    assert run.status == 130
    assert run.summary["network"]["replay"]["bit_exact"] is True
    for name in NAMES:
        record = record_of(run, name)
        assert replay(record).bit_exact
        assert len(record.begun_lives("sensor")) == 2
        assert len(record.begun_lives("netem")) == 2
