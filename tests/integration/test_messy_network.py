"""Live, encrypted runs with impairments of updates, acknowledgements and actuations."""

import json
from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_events import packet_outcomes
from cosim.record.run_record import RunRecord, load_record
from noack.protocol import record_tables
from noack.protocol.wire_format import Flow, read_header
from tests.helpers import live_runs as live
from tests.helpers.live_runs import AT_RATE, Finished, assert_complete, run_scenario, settings

pytestmark = pytest.mark.live

MANSD = 2
IMPAIRMENTS = [
    {"kind": "delay", "delay_s": 0.01, "jitter_s": 0.02},
    {"kind": "reorder", "probability": 0.2},
    {"kind": "duplicate", "probability": 0.2},
    {"kind": "corrupt", "probability": 0.2},
]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    tables = "{" + "}, {".join(
        ", ".join(f"{key} = {json.dumps(value)}" for key, value in impairment.items())
        for impairment in IMPAIRMENTS
    ) + "}"  # fmt: skip
    values = {
        "horizon_s": 4.0,
        "speed": 2.0,
        "trigger__beta": 0.001,  # an event at almost every measurement
        "network__mansd": MANSD,
        "network__encrypted": True,
        "network__loss__probability": 0.1,
        "network__protocol": "ack",
        "network__acknowledgements__timeout_s": 0.02,
        "network__acknowledgements__loss__model": "bernoulli",
        "network__acknowledgements__loss__probability": 0.3,
    }
    return run_scenario(
        tmp_path_factory.mktemp("runs"), *AT_RATE, *settings(**values),
        "--set", f"network.impairments=[{tables}]",
        "--set", f"network.acknowledgements.impairments=[{tables}]",
    )  # fmt: skip


@pytest.fixture(scope="module")
def record(finished: Finished) -> RunRecord:
    assert finished.status == 0, finished.stderr
    return load_record(finished.run_dir)


def test_the_run_is_complete_and_replayed_bit_for_bit(finished: Finished, record: RunRecord) -> None:
    summary = finished.summary
    assert summary["exit"] == {"status": 0, "reason": "horizon"}
    assert_complete(finished.loop)
    verdicts = {claim["source"]: claim["verdict"] for claim in finished.loop["claims"]}
    assert verdicts == {"network": "held", "(I1)": "unchecked"}
    heads = record[record_tables.NETEM_PACKET]["head"]
    assert {read_header(head.tobytes()).version for head in heads} == {2}  # encrypted
    answers = finished.loop["acknowledgements"]
    assert answers["sent"] == finished.loop["deliveries"] > 10
    assert 0 <= answers["sent"] - answers["lost"] - answers["received"] <= 2  # in flight
    replayed = replay(record)
    compared = {hop.hop: hop.compared for hop in replayed.messages}
    assert compared["controller → netem"] == len(record[record_tables.CONTROLLER_DELIVERY])
    assert compared["netem → sensor"] == len(record[record_tables.SENSOR_ACKNOWLEDGEMENT])
    logs = [log.read_text() for log in (finished.run_dir / "logs").iterdir()]
    assert not any("Traceback" in text for text in (finished.stderr, *logs))


def test_each_process_receives_from_its_senders_only(finished: Finished) -> None:
    reports = json.loads((finished.run_dir / "reports.json").read_text())
    roles = {reports[role]["channel"]["local"]: role for role in reports}
    senders = {
        role: {roles[source] for source in report["channel"]["received_from"]}
        for role, report in reports.items()
    }
    assert senders == {
        "plant": {"controller"},
        "sensor": {"plant", "netem"},
        "netem": {"sensor", "controller"},
        "controller": {"netem"},
    }


def test_forwarded_updates_reach_the_controller_and_the_cap_holds(
    finished: Finished, record: RunRecord
) -> None:
    packets, deliveries = record[record_tables.NETEM_PACKET], record[record_tables.CONTROLLER_DELIVERY]
    updates = packets[packets["flow"] == record_tables.UPDATES]
    forwarded = int((updates["release_ns"] >= 0).sum() + (updates["copy_ns"] >= 0).sum())
    rejected = finished.loop["rejected_datagrams"]["controller"]
    assert rejected["stale"] > 0
    assert forwarded == len(deliveries) + sum(rejected.values())
    sent = [read_header(head.tobytes()).sequence for head in updates["head"]]
    assert sent == list(range(len(sent)))
    ends = np.concatenate([[-1], deliveries["sequence"], [len(sent)]])
    assert np.diff(ends).max() - 1 <= MANSD
    assert deliveries["dropouts"].max() == np.diff(ends[:-1]).max() - 1
    assert finished.loop["longest_loss_burst"] <= MANSD
    causes = finished.loop["drops_by_cause"]
    assert {"dropped", "corrupted"} <= set(causes)
    assert sum(causes.values()) == finished.loop["drops"]


ACTUATION = (
    'network.actuation={mansd=3, loss={model="bernoulli", probability=0.4}, '
    'impairments=[{kind="delay", delay_s=0.005, jitter_s=0.01}]}'
)


def test_actuations_are_lost_within_their_guarantee(tmp_path: Path) -> None:
    sets = ("horizon_s=4", "speed=2", ACTUATION, "controller.predictions=5", "trigger.beta=0.02")
    options = [word for setting in sets for word in ("--set", setting)]
    finished = run_scenario(tmp_path, *AT_RATE, *options)
    assert finished.status == 0, finished.stderr
    live.assert_complete(finished.loop)
    record = load_record(finished.run_dir)
    actuations, outcomes = finished.loop["actuations"], packet_outcomes(record, Flow.ACTUATION)
    assert actuations["sent"] == len(record[record_tables.CONTROLLER_STEP])
    assert actuations["lost"] > 0.2 * actuations["sent"]
    assert actuations["longest_loss_burst"] == outcomes.longest_loss_burst() <= 3
    assert actuations["received"] == outcomes.forwarded.sum()
    channels = {role: report["channel"] for role, report in record.reports.items()}
    assert set(channels["plant"]["received_from"]) == {channels["netem"]["local"]}
