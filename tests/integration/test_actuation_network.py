"""A live run whose updates and actuations cross the network."""

import json
import signal

import numpy as np
import pytest

from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord, load_record
from noack.protocol.machine_interface import GENERATION
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_ACTUATION, PLANT_STEP
from noack.protocol.wire_format import Flow
from tests.integration import conftest as live
from tests.integration.conftest import AT_RATE, Finished, run_scenario
from tests.integration.test_restarts import kill, let_run

ACTUATION = (
    'network.actuation={mansd=3, loss={model="bernoulli", probability=0.4}, '
    'impairments=[{kind="delay", delay_s=0.005, jitter_s=0.01}]}'
)


RESTARTED = ("controller", "netem")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    sets = ("horizon_s=4", ACTUATION, "controller.predictions=5", "trigger.beta=0.02")
    options = [word for one in sets for word in ("--set", one)]
    return run_scenario(tmp_path_factory.mktemp("runs"), *AT_RATE, *options)


@pytest.fixture(scope="module")
def record(finished: Finished) -> RunRecord:
    assert finished.status == 0, finished.stderr
    return load_record(finished.run_dir)


def test_the_run_is_complete_and_replayed_bit_for_bit(finished: Finished) -> None:
    live.assert_complete(finished.loop)
    reports = json.loads((finished.run_dir / "reports.json").read_text())
    roles = {reports[role]["channel"]["local"]: role for role in reports}
    sources = reports["plant"]["channel"]["received_from"]
    assert {roles[source] for source in sources} == {"netem"}


def test_actuations_are_lost_within_their_guarantee(finished: Finished, record: RunRecord) -> None:
    found, outcomes = (
        finished.loop["actuations"],
        packet_outcomes(record, Flow.ACTUATION),
    )
    assert found["sent"] == len(record[CONTROLLER_STEP])
    assert found["lost"] > 0.2 * found["sent"]
    assert found["longest_loss_burst"] == outcomes.longest_loss_burst() <= 3
    assert found["received"] == outcomes.forwarded.sum()


@pytest.fixture(scope="module")
def restarted(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A run in which controller and emulator were killed while actuations were lost."""
    with live.begun(tmp_path_factory.mktemp("restarted")) as start:
        running = start(
            *live.settings(horizon_s=4000.0, recovery__rejoin_within_s=60, realtime__enabled=False),
            *live.settings(controller__predictions=5),
            *AT_RATE,
            *("--set", ACTUATION),
        )
        running.wait_started()
        for role in RESTARTED:
            kill(running, role)
        let_run(running, 2)
        running.process.send_signal(signal.SIGINT)
        return running.finish()


def test_restarted_processes_go_on_with_lossy_actuations(restarted: Finished) -> None:
    assert restarted.status == 130, restarted.stderr
    assert restarted.loop["replay"]["bit_exact"]
    assert {one["process"] for one in restarted.loop["restarts"]} == set(RESTARTED)
    record = load_record(restarted.run_dir)
    steps, actuations = record[CONTROLLER_STEP], record[PLANT_ACTUATION]
    # The plant applies inputs of the restarted controller, through the restarted emulator.
    assert (actuations["sequence"] >= GENERATION).any()
    newest = record[PLANT_STEP]["actuation"]
    assert newest[-1] >= GENERATION
    assert (np.diff(newest) >= 0).all()
    at = np.searchsorted(steps["sequence"], actuations["sequence"])
    recorded = steps["sequence"][np.minimum(at, len(steps) - 1)] == actuations["sequence"]
    assert (steps["u"][at[recorded]] == actuations["u"][recorded]).all()
    assert recorded.mean() > 0.9  # the last ticks of a killed controller may not be on disk


def test_claims_of_a_restarted_run_are_judged(restarted: Finished) -> None:
    found = restarted.loop["actuations"]
    assert found["lost"] > 0.2 * found["sent"]
    claims = restarted.loop["claims"]
    assert claims
    assert {claim["verdict"] for claim in claims} <= {"held", "void", "not applicable"}
    assert restarted.loop["assumption_violations"]  # e.g. the input of a dead controller was old
