"""A live, encrypted run with impairments of updates and of acknowledgements, over real UDP."""

import json

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_record import RunRecord, load_record
from noack.protocol.record_tables import (
    ACKNOWLEDGEMENTS,
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
    SENSOR_ACKNOWLEDGEMENT,
    UPDATES,
)
from noack.protocol.wire_format import Flow, read_header
from tests.integration.conftest import (
    AT_RATE,
    Finished,
    assert_complete,
    run_scenario,
    settings,
)

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
        ", ".join(f"{key} = {json.dumps(value)}" for key, value in one.items())
        for one in IMPAIRMENTS
    ) + "}"  # fmt: skip
    values = {
        "horizon_s": 8.0,
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


def test_the_run_is_complete_and_replayed_bit_for_bit(
    finished: Finished, record: RunRecord
) -> None:
    summary = finished.summary
    assert summary["exit"] == {"status": 0, "reason": "horizon"}
    assert_complete(finished.loop)
    assert [claim["verdict"] for claim in finished.loop["claims"]] == ["void"]
    found = replay(record)
    compared = {leg.leg: leg.compared for leg in found.messages}
    assert compared["controller → netem"] == len(record[CONTROLLER_DELIVERY])
    assert compared["netem → sensor"] == len(record[SENSOR_ACKNOWLEDGEMENT])
    logs = [log.read_text() for log in (finished.run_dir / "logs").iterdir()]
    assert not any("Traceback" in text for text in (finished.stderr, *logs))


def test_acknowledgements_are_counted_by_outcome(finished: Finished, record: RunRecord) -> None:
    found = finished.loop["acknowledgements"]
    assert found["sent"] == finished.loop["deliveries"] > 10
    assert found["lost"] > 3
    assert found["received"] > 3
    assert 0 <= found["sent"] - found["lost"] - found["received"] <= 2  # in flight at the end
    packets = record[NETEM_PACKET]
    answers = packets[packets["flow"] == ACKNOWLEDGEMENTS]
    heads = [read_header(head.tobytes()) for head in answers["head"]]
    assert {head.flow for head in heads} == {Flow.ACKNOWLEDGEMENT}
    expected = record[CONTROLLER_DELIVERY]["sequence"]
    assert [head.sequence for head in heads] == expected.tolist()
    assert set(answers["size_bytes"].tolist()) == {48}


def test_every_datagram_is_encrypted(record: RunRecord) -> None:
    heads = record[NETEM_PACKET]["head"]
    assert {read_header(head.tobytes()).version for head in heads} == {2}


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
    packets, taken = record[NETEM_PACKET], record[CONTROLLER_DELIVERY]
    updates = packets[packets["flow"] == UPDATES]
    forwarded = int((updates["release_ns"] >= 0).sum() + (updates["copy_ns"] >= 0).sum())
    rejected = finished.loop["rejected_datagrams"]["controller"]
    assert rejected["stale"] > 0
    assert forwarded == len(taken) + sum(rejected.values())
    sent = [read_header(head.tobytes()).sequence for head in updates["head"]]
    assert sent == list(range(len(sent)))
    ends = np.concatenate([[-1], taken["sequence"], [len(sent)]])
    assert np.diff(ends).max() - 1 <= MANSD
    assert taken["dropouts"].max() == np.diff(ends[:-1]).max() - 1
    assert finished.loop["longest_loss_burst"] <= MANSD
    causes = finished.loop["drops_by_cause"]
    assert {"dropped", "corrupted"} <= set(causes)
    assert sum(causes.values()) == finished.loop["drops"]
