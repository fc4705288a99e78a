"""A whole run of real processes: its files, and what its processes did together.

tests/cosim/simulation/test_whole_loop.py compares what each machine computes with a reference; the
replay of this run shows that its processes computed the same.
"""

import json
import os
import signal
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import rerun.chunk

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.conformance.run_conformance import conformance_of
from cosim.analysis.conformance.verdicts import Failed
from cosim.analysis.replay import replay
from cosim.output.viewer import blueprint
from cosim.record.run_events import changes_of
from cosim.record.run_record import RunRecord, load_record
from cosim.simulation.virtual_time import simulate
from netem.core.clock import NS_PER_S
from netem.core.packet_rows import NETEM_PACKET
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
    tables,
)
from noack.protocol.roles import LOOP_ROLES
from tests.cosim.output.viewer.recordings import read, series
from tests.helpers.command_line import invoke
from tests.helpers.live_runs import (
    AT_RATE,
    Finished,
    assert_complete,
    run_scenario,
    settings,
    spooled,
    start_runs,
    wait_for,
)

pytestmark = pytest.mark.live

CERTIFIED = "certified for the scenario's plant"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    with start_runs(tmp_path_factory.mktemp("finished")) as begin:
        return begin(*settings(speed=2.5, horizon_s=4.0), viewer=True).finish()


@pytest.fixture(scope="module")
def record(finished: Finished) -> RunRecord:
    return load_record(finished.run_dir)


def test_a_run_completes_with_a_complete_summary(finished: Finished) -> None:
    assert finished.status == 0, finished.stderr
    assert finished.summary["exit"] == {"status": 0, "reason": "horizon"}
    assert finished.loop["missing_samples"] == 0
    assert finished.loop["unintended_losses"] == 0
    violations = finished.loop["violations"]
    assert "dropouts" not in {violation["cause"] for violation in violations}  # deadlines may be missed
    assert finished.loop["rejected_datagrams"] == {}
    verdicts = {claim["source"]: claim["verdict"] for claim in finished.loop["claims"]}
    assert verdicts.keys() >= {"(I1)", "certificate", "box certificate"}
    assert "violated" not in verdicts.values()
    # States of a few units and some thousand steps: far below any physical difference.
    assert finished.loop["identity_residual_max"] < 1e-11
    ideal = finished.loop["ideal_loop"]
    assert 0 < ideal["rms_difference"] < 0.5 * ideal["rms_x"]


def test_the_run_directory_holds_everything(finished: Finished) -> None:
    run_dir = finished.run_dir
    assert json.loads((run_dir / "summary.json").read_text()) == finished.summary
    assert json.loads((run_dir / "environment.json").read_text())["packages"]["numpy"]
    assert (run_dir / "recording.rrd").stat().st_size > 10_000
    assert {log.name for log in (run_dir / "logs").iterdir()} == {
        f"{role}.log" for role in ("plant", "sensor", "controller", "netem", "recorder")
    }
    assert not (run_dir / "spool").exists()
    assert "warning" not in finished.stderr


def test_the_run_is_replayed_bit_for_bit(record: RunRecord, finished: Finished) -> None:
    result = replay(record)
    assert result.first_difference is None, str(result.first_difference)
    assert result.gaps == []
    assert result.inputs == sum(len(record[table]) for table in tables(1, 1))
    assert all(hop.compared == hop.received > 0 for hop in result.messages)
    assert finished.loop["replay"] == result.verdict().model_dump()
    assert finished.summary["kind"] == record.kind == "live"


def test_the_run_is_a_run_of_its_loop_documents_unless_it_was_late(
    record: RunRecord, finished: Finished
) -> None:
    late, failure = {Failed.LIMIT, Failed.WHEN, Failed.INPUT}, conformance_of(record).failure
    assert failure is None or failure.kind in late, failure
    parts = finished.loop["conformance"]
    assert [part["certificate"] for part in parts] == ["certificate", "box certificate"]
    assert {part["failure"]["kind"] for part in parts if part["failure"]} <= late


def test_the_recording_shows_the_record(finished: Finished, record: RunRecord) -> None:
    reader = rerun.chunk.RrdReader(finished.run_dir / "recording.rrd")
    (store,) = reader.recordings()
    rows: Counter[str] = Counter()
    for chunk in reader.stream(store=store):
        batch = chunk.to_record_batch()
        if blueprint.TIMELINE in batch.schema.names:
            rows[chunk.entity_path.removeprefix("/")] += batch.num_rows
    (summary,) = finished.summary["loops"]
    assert rows[blueprint.RECEPTION_FORCED] == summary["forced_deliveries"]
    assert rows[blueprint.RECEPTION] == summary["deliveries"] - summary["forced_deliveries"]
    assert rows[blueprint.DROP] == summary["drops"]
    assert rows[blueprint.EVENT] == summary["events"]
    assert rows[blueprint.INPUT] == len(record["controller_step"])
    for name in record.loop.state_names:
        assert rows[blueprint.state_path(name)] == len(record["sensor_measurement"])


def test_the_recording_shows_the_bounds(finished: Finished, record: RunRecord) -> None:
    """The curves drawn during the run equal those that its end evaluates for its schedule."""
    claims = RunClaims(record)
    claims.evidence.late = None  # the recording has the bounds of the scenario's schedule
    envelopes = claims.envelopes()
    (identity,) = [e.values for e in envelopes if e.label == "bound from (I1)"]
    (certified,) = [e.values for e in envelopes if e.quantity == "x" and e.label == CERTIFIED]
    chunks = read(finished.run_dir / "recording.rrd")
    t_ns, drawn = series(chunks, blueprint.ERROR)
    order = np.argsort(t_ns)
    np.testing.assert_allclose(drawn[order, 0], identity, rtol=1e-9, atol=1e-12)
    _, drawn = series(chunks, blueprint.SIZE_LOG10)
    np.testing.assert_allclose(10 ** drawn[order, 0], certified, rtol=1e-9)


def set_parameters(*words: str) -> dict[str, Any]:
    result = invoke("set", "--json", *words)
    answer: dict[str, Any] = json.loads(result.stdout)
    assert result.exit_code == answer.get("exit", {"status": 0})["status"], result.stderr
    return answer


class ChangedRun(NamedTuple):
    """A run that was changed twice and then stopped, and what was answered while it ran."""

    early_summary: Any
    first: dict[str, Any]
    second: dict[str, Any]
    invalid: dict[str, Any]
    finished: Finished
    left_behind: list[Any]
    active_runs: list[Path]
    """Files of active runs that are left."""


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> ChangedRun:
    folder = tmp_path_factory.mktemp("changed")
    with start_runs(folder) as begin, pytest.MonkeyPatch.context() as patched:
        patched.setenv("XDG_RUNTIME_DIR", str(folder))
        running = begin(*AT_RATE, *settings(speed=4.0, horizon_s=1000.0))
        running.wait_recording()
        early_summary = invoke("summary", running.runs / "latest")
        first = set_parameters("loss.p", "0.5", "mansd=2")
        second = set_parameters("setpoint", "[0.0, 0.0, 0.0, 1.0]")
        invalid = set_parameters("loss.p", "1.5")
        until_ns = (second["from_s"] + 1) * NS_PER_S
        wait_for(lambda: spooled(running, PLANT_STEP)["t_ns"][-1] > until_ns)
        running.process.send_signal(signal.SIGTERM)
        finished, left_behind = running.finish(), running.left_behind()
    active_runs = [*(folder / f"noack-{os.getuid()}" / "runs").iterdir()]
    return ChangedRun(early_summary, first, second, invalid, finished, left_behind, active_runs)


def test_there_is_no_summary_of_an_active_run(changed: ChangedRun) -> None:
    assert changed.early_summary.exit_code == 2
    assert "still under way" in changed.early_summary.stderr


def test_a_change_is_answered_and_a_wrong_one_is_refused(changed: ChangedRun) -> None:
    assert changed.second["runtime_parameters"]["network.mansd"] == 2
    assert changed.invalid["exit"]["status"] == 2
    assert "expected at most 1" in changed.invalid["error"]


def test_a_stopped_run_leaves_nothing_behind(changed: ChangedRun) -> None:
    assert changed.finished.status == 143, changed.finished.stderr
    assert changed.finished.summary["exit"]["reason"] == "stopped on request (SIGTERM)"
    assert changed.left_behind == []
    assert changed.active_runs == []


def test_the_record_of_a_stopped_run_is_complete_and_its_claims_are_checked_until_then(
    changed: ChangedRun,
) -> None:
    loop, reached_s = changed.finished.loop, changed.finished.summary["reached_s"]
    until_s = loop["judged_until_s"]
    assert 0 < until_s <= reached_s + 0.1
    assert all((claim["since_s"] or 0.0) <= until_s for claim in loop["claims"])
    assert [claim for claim in loop["claims"] if claim["verdict"] == "violated"] == []
    assert_complete(loop)
    assert loop["identity_residual_relative"] < 1e-9
    assert set(loop["realtime"]) == set(LOOP_ROLES)


def test_changes_are_recorded_and_are_no_violation(changed: ChangedRun) -> None:
    summary, record = changed.finished.summary, load_record(changed.finished.run_dir)
    times_s = [changed.first["from_s"], changed.second["from_s"]]
    assert [change["t_s"] for change in summary["changes"]] == times_s
    assert summary["changes"][1]["settings"] == {"controller.setpoint": [0.0, 0.0, 0.0, 1.0]}
    assert record.scenario.network.mansd == 4  # as it was at the start
    changes = [notice["text"] for notice in record.notices if notice["level"] == "change"]
    assert len(changes) == 2
    assert all("; requested at " in text for text in changes)
    late = (max(change.since_ns.values()) > change.change.t_ns for change in changes_of(record))
    if not any(late):  # a late change is a recorded violation
        violations = changed.finished.loop["violations"]
        assert not {violation["cause"] for violation in violations} & {"dropouts", "change"}


RATE_HZ = 5.0
HORIZON_S = 4.0
ENOUGH_S = 2.5
SAME = {
    PLANT_STEP: ("input", "sequence", "t_ns", "actuation"),
    PLANT_ACTUATION: ("input", "sequence", "t_ns"),
    SENSOR_MEASUREMENT: ("input", "sequence", "t_ns", "event"),
    NETEM_PACKET: ("input", "sequence", "flow", "fate", "consecutive_losses", "size_bytes"),
    CONTROLLER_STEP: ("input", "sequence", "t_ns", "model_t_ns"),
    CONTROLLER_DELIVERY: ("input", "sequence", "t_ns", "model_t_ns", "dropouts"),
}
CLOSE = {
    PLANT_STEP: ("x", "u"),
    PLANT_ACTUATION: ("u",),
    SENSOR_MEASUREMENT: ("x", "x_s", "e_s_norm", "threshold"),
    CONTROLLER_STEP: ("x_c", "u"),
    CONTROLLER_DELIVERY: ("x", "x_c_before", "x_c"),
}


def in_turn_until_ns(live: RunRecord, simulated: RunRecord) -> int:
    """Return the time in ns of the first live event in a different order than in the simulation.

    Only the order of the two kinds of input of the plant and of the controller can differ; the
    ``input`` numbers show it. The plant's applied actuation shows which actuation came in time.
    """
    first_ns = simulated.scenario.timing.horizon_ns + 1
    for table, columns in (
        (PLANT_STEP, ("input", "actuation")),
        (PLANT_ACTUATION, ("input",)),
        (CONTROLLER_STEP, ("input",)),
        (CONTROLLER_DELIVERY, ("input",)),
    ):
        count = min(len(live[table]), len(simulated[table]))
        for column in columns:
            other = live[table][column][:count] != simulated[table][column][:count]
            if other.any():
                first_ns = min(first_ns, int(simulated[table]["now_ns"][np.argmax(other)]))
    return first_ns


def test_a_live_run_agrees_with_the_simulated_run(tmp_path: Path) -> None:
    """Up to a stall: with steps of 200 ms, only a process that is 50 ms late changes the order of events."""
    values = {
        "horizon_s": HORIZON_S,
        "plant__rate_hz": RATE_HZ,
        "controller__rate_hz": RATE_HZ,
        "trigger__beta": 0.02,
        "network__loss__probability": 0.6,
        "network__initial_sync": "known_state",
        "plant__measure_every": 2,
    }
    finished = run_scenario(tmp_path / "runs", *settings(**values))
    assert finished.status == 0, finished.stderr
    live = load_record(finished.run_dir)
    simulated = simulate(live.scenario)
    assert (simulated[SENSOR_MEASUREMENT]["event"] >= 0).sum() > 3
    until_ns = in_turn_until_ns(live, simulated)
    compare(live, simulated, until_ns)
    if until_ns < ENOUGH_S * NS_PER_S:
        assert max(late["max"] for late in finished.loop["lateness_us"].values()) > 5e4


def compare(live: RunRecord, simulated: RunRecord, until_ns: int) -> None:
    compared_rows = 0
    for table, columns in SAME.items():
        # A live row may be later than in the simulation, but the order is the same.
        rows = simulated[table][simulated[table]["now_ns"] < until_ns]
        live_rows = live[table][: len(rows)]
        for column in columns:
            np.testing.assert_array_equal(live_rows[column], rows[column], f"{table}.{column}")
        for column in CLOSE.get(table, ()):
            # The same arithmetic in the same order, but BLAS may use another kernel.
            np.testing.assert_allclose(
                live_rows[column], rows[column], rtol=1e-9, atol=1e-12, err_msg=f"{table}.{column}"
            )
        compared_rows += len(rows)
    assert until_ns < ENOUGH_S * 1e9 or compared_rows > 40
    if until_ns > simulated.scenario.timing.horizon_ns:
        for table in SAME:
            assert len(live[table]) == len(simulated[table]), table
