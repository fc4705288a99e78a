"""A live run whose updates and actuations cross the network."""

import json

import numpy as np
import pytest

from cosim.record.packet_outcomes import packet_outcomes
from cosim.record.run_record import RunRecord, load_record
from netem.engine.native_pump import compiled_pump
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_ACTUATION, PLANT_STEP
from noack.protocol.wire_format import Flow
from tests.integration.conftest import AT_RATE, Finished, run_scenario

ACTUATION = (
    'network.actuation={mansd=3, loss={model="bernoulli", probability=0.4}, '
    'impairments=[{kind="delay", delay_s=0.005, jitter_s=0.01}]}'
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    compiled_pump()  # else the run would use the plain engine
    sets = ("horizon_s=4", ACTUATION, "controller.predictions=5", "trigger.beta=0.02")
    options = [word for one in sets for word in ("--set", one)]
    return run_scenario(tmp_path_factory.mktemp("runs"), *AT_RATE, *options)


@pytest.fixture(scope="module")
def record(finished: Finished) -> RunRecord:
    assert finished.status == 0, finished.stderr
    return load_record(finished.run_dir)


def test_the_run_is_complete_and_replayed_bit_for_bit(finished: Finished) -> None:
    summary = finished.summary
    assert summary["replay"]["bit_exact"]
    assert summary["replay"]["complete"]
    assert summary["unintended_losses"] == summary["missing_samples"] == 0
    reports = json.loads((finished.run_dir / "reports.json").read_text())
    assert reports["netem"]["channel"]["engine"] == "batched"
    roles = {reports[role]["channel"]["local"]: role for role in reports}
    sources = reports["plant"]["channel"]["received_from"]
    assert {roles[source] for source in sources} == {"netem"}


def test_actuations_are_lost_within_their_guarantee(finished: Finished, record: RunRecord) -> None:
    found, outcomes = finished.summary["actuations"], packet_outcomes(record, Flow.ACTUATION)
    assert found["sent"] == len(record[CONTROLLER_STEP])
    assert found["lost"] > 0.2 * found["sent"]
    assert found["longest_loss_burst"] == outcomes.longest_loss_burst() <= 3
    assert found["received"] == outcomes.forwarded.sum()


def test_the_plant_applies_the_entry_whose_time_has_come(record: RunRecord) -> None:
    steps, received = record[PLANT_STEP], record[PLANT_ACTUATION]
    steps = steps[steps["actuation"] >= 0]
    newest = received[np.searchsorted(received["sequence"], steps["actuation"])]
    inputs = np.concatenate([newest["u"], newest["predicted"]], axis=1).reshape(len(steps), 5, -1)
    period_ns = record.scenario.timing.controller_period_ns
    entries = np.clip((steps["t_ns"] - newest["t_ns"]) // period_ns, 0, 4)
    assert (steps["entry"] == entries).all()
    assert (steps["u"] == inputs[np.arange(len(steps)), entries]).all()
    assert len(np.unique(entries)) > 2
