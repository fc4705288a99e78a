"""Processes that are killed during a run and restarted."""

import signal

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.record.processes import generation_indices
from cosim.record.run_record import Rows, RunRecord, load_record
from noack.protocol.record_tables import OWNER
from noack.protocol.roles import GENERATION
from noack.theory.certificates.conditions import allowed_conditions
from tests.helpers import live_runs as live

LOOP = ("plant_step", "sensor_measurement", "controller_step")
RESTARTED = ("recorder", "controller", "sensor", "netem")


def is_whole(running: live.Running, table: str) -> bool:
    """Whether a table has no gaps."""
    inputs = live.spooled(running, table)["sequence"] % GENERATION
    return bool((np.diff(np.unique(inputs)) == 1).all())


def kill(running: live.Running, role: str) -> None:
    """Kill a process that has rows on disk; wait until its replacement has, too."""
    table = live.ROWS_OF[role]
    live.wait_for(lambda: len(live.spooled(running, table)) > 0)
    before = live.child_of(running.process, role)
    assert before is not None
    before.kill()
    live.wait_for(lambda: live.goes_on(running, role))


def let_run(running: live.Running, simulated_s: float) -> None:
    def now_ns() -> int:
        return int(live.spooled(running, "plant_step")["t_ns"].max())

    until_ns = now_ns() + simulated_s * 1e9
    live.wait_for(lambda: now_ns() > until_ns)


@pytest.fixture(scope="module")
def restarted(tmp_path_factory: pytest.TempPathFactory) -> live.Finished:
    """A run in which the processes were killed one after the other."""
    folder = tmp_path_factory.mktemp("restarted")
    with live.start_runs(folder) as start:
        running = start(
            *live.settings(speed=3.0, horizon_s=4000.0, recovery__rejoin_within_s=60),
            *live.AT_RATE,
            *live.settings(realtime__enabled=False, network__mansd=1, trigger__floor=0.02),
        )
        running.wait_started()
        for role in RESTARTED:
            kill(running, role)
            if role == "recorder":
                # Unacknowledged rows are sent again. Wait until all of them are on disk before
                # the next process is killed.
                let_run(running, 9)
                live.wait_for(lambda: all(is_whole(running, table) for table in LOOP))
        let_run(running, 12)
        running.process.send_signal(signal.SIGINT)
        finished = running.finish()
        assert running.left_behind() == []
        return finished


def test_the_run_continues_and_lists_its_restarts(restarted: live.Finished) -> None:
    assert restarted.status == 130, restarted.stderr
    assert restarted.summary["exit"]["reason"] == "stopped by the user (SIGINT)"
    restarts = {restart["process"]: restart for restart in restarted.loop["restarts"]}
    assert restarts.keys() == set(RESTARTED)
    for role, restart in restarts.items():
        assert restart["generation"] == 1
        assert restart["what"] == f"restarted: {role} died: killed by SIGKILL"
        assert role == "recorder" or restart["last_s"] < restart["first_s"]
    for role in RESTARTED:
        assert f"{role} died: killed by SIGKILL at " in restarted.stderr
        assert f"{role} runs again at " in restarted.stderr


@pytest.fixture(scope="module")
def record(restarted: live.Finished) -> RunRecord:
    return load_record(restarted.run_dir)


def rows_of_generation(record: RunRecord, table: str, index: int) -> Rows:
    rows = record[table]
    chosen: Rows = rows[generation_indices(rows, record.generation_numbers(OWNER[table])) == index]
    return chosen


def test_no_recorded_row_is_lost_and_all_rows_are_replayed(
    restarted: live.Finished, record: RunRecord
) -> None:
    assert restarted.loop["missing_samples"] == 0
    assert restarted.loop["identity_residual_relative"] < 1e-11
    verdict = restarted.loop["replay"]
    assert verdict["bit_exact"], verdict
    assert verdict["inputs"] == sum(len(record[table]) for table in record.tables)
    steps = record["plant_step"]["sequence"]  # although its recorder was killed
    assert np.array_equal(steps, np.arange(len(steps)))


def test_a_restarted_sensor_and_network_begin_with_a_delivered_measurement(
    record: RunRecord,
) -> None:
    first = rows_of_generation(record, "sensor_measurement", 1)[0]
    assert first["event"] == GENERATION
    assert np.array_equal(first["x"], first["x_s"])
    packets = rows_of_generation(record, "netem_packet", 1)
    assert packets["consecutive_losses"][0] == 0
    assert packets["consecutive_losses"].max() <= 1
    # A restarted process has lost the accepted numbers; the generation identifies old messages.
    for table in ("sensor_measurement", "controller_delivery"):
        last_ns = rows_of_generation(record, table, 0)["t_ns"].max()
        assert rows_of_generation(record, table, 1)["t_ns"].min() > last_ns


def test_a_restarted_controller_outputs_zero_until_its_first_update(record: RunRecord) -> None:
    ticks = rows_of_generation(record, "controller_step", 1)
    deliveries = rows_of_generation(record, "controller_delivery", 1)
    waiting = ticks["input"] < deliveries["input"][0]
    assert not ticks["u"][waiting].any()
    assert (ticks["u"][~waiting] != 0).any()
    number = ticks["t_ns"][0] // record.scenario.timing.controller_period_ns
    assert ticks["sequence"][0] % GENERATION == number
    norms = np.linalg.norm(record["plant_step"]["x"], axis=1)
    assert norms[-100:].max() < 0.1 * norms.max()


def test_claims_are_void_from_the_first_outage_on(record: RunRecord) -> None:
    claims = ClaimEvaluation(record).evaluate()
    verdicts = {claim.verdict for claim in claims}  # a late run may have no claim of some kind
    assert "void" in verdicts <= {"void", "not applicable"}
    # The controller dies first. The plant knows its last actuation, of which the row may be lost.
    steps = record["plant_step"]
    newest = steps["actuation"][steps["actuation"] < GENERATION].max()
    gone_s = steps["t_ns"][steps["actuation"] == newest][0] * 1e-9
    # Certificates allow for inputs that are this old.
    allowed_s = 0.1 + allowed_conditions(record.scenario).hold_s
    assert all(claim.since_s <= gone_s + allowed_s for claim in claims if claim.since_s is not None)
