"""The acknowledgement baseline with real processes over real UDP."""

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_record import RunRecord, load_record
from noack.protocol.record_tables import (
    ACKNOWLEDGEMENTS,
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
    NO_SEQUENCE,
    SENSOR_ACKNOWLEDGEMENT,
    SENSOR_MEASUREMENT,
)
from noack.protocol.wire_format import Flow, read_header
from tests.integration.conftest import Finished, run_scenario, settings


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    values = {
        "horizon_s": 10.0,
        "speed": 4.0,
        "plant__rate_hz": 100.0,
        "controller__rate_hz": 100.0,
        "trigger__beta": 0.05,
        "network__loss__probability": 0.5,
        "network__protocol": "ack",
        "network__acknowledgements__loss__model": "bernoulli",
        "network__acknowledgements__loss__probability": 0.5,
    }
    return run_scenario(tmp_path_factory.mktemp("runs"), *settings(**values))


@pytest.fixture(scope="module")
def record(finished: Finished) -> RunRecord:
    return load_record(finished.run_dir)


def test_a_live_run_acknowledges_and_loses_acknowledgements(
    finished: Finished, record: RunRecord
) -> None:
    assert finished.status == 0, finished.stderr
    summary = finished.summary
    found = summary["acknowledgements"]
    assert found["sent"] == summary["deliveries"] > 10
    assert found["lost"] > 3
    assert found["received"] > 3
    assert found["sent"] == found["lost"] + found["received"]
    assert summary["unintended_losses"] == summary["missing_samples"] == 0
    assert summary["rejected_datagrams"] == {}
    assert [claim["verdict"] for claim in summary["claims"]] == ["void"]
    packets = record[NETEM_PACKET]
    answers = packets[packets["flow"] == ACKNOWLEDGEMENTS]
    heads = [read_header(head.tobytes()) for head in answers["head"]]
    assert all(head is not None and head.flow == Flow.ACKNOWLEDGEMENT for head in heads)
    assert [head.sequence for head in heads if head is not None] == record[CONTROLLER_DELIVERY][
        "sequence"
    ].tolist()
    assert set(answers["size_bytes"].tolist()) == {48}


def test_a_live_run_is_replayed_bit_for_bit(finished: Finished, record: RunRecord) -> None:
    assert finished.summary["replay"]["bit_exact"] is True
    found = replay(record)
    assert found.bit_exact
    compared = {leg.leg: leg.compared for leg in found.messages}
    assert compared["controller → netem"] == len(record[CONTROLLER_DELIVERY])
    assert compared["netem → sensor"] == len(record[SENSOR_ACKNOWLEDGEMENT])


def test_only_an_acknowledgement_resets_the_sensors_model(record: RunRecord) -> None:
    rows, answers = record[SENSOR_MEASUREMENT], record[SENSOR_ACKNOWLEDGEMENT]
    sent = rows[rows["event"] != NO_SEQUENCE]
    for answer in answers:
        (event,) = sent[sent["event"] == answer["sequence"]]
        assert event["t_ns"] == answer["t_ns"]
        if answer["model_t_ns"] == answer["t_ns"]:
            assert answer["x_s"].tobytes() == event["x"].tobytes()
    # Between two measurements without an acknowledgement, x_s follows the model only.
    step = record.loop.H * 0.01
    resets = np.searchsorted(rows["input"], answers["input"])
    jumps = rows["x_s"][1:] - rows["x_s"][:-1]
    free = np.setdiff1d(np.arange(1, len(rows)), resets)
    size = np.linalg.norm(rows["x_s"], axis=1)
    bound = np.expm1(np.linalg.norm(step, 2)) * size[free - 1] * 1.001 + 1e-12
    assert (np.linalg.norm(jumps[free - 1], axis=1) <= bound).all()
    at_once = (rows["event"] != NO_SEQUENCE).sum() - len(answers)
    assert at_once > 3  # if the update or its acknowledgement is lost, an event does not reset x_s


def test_each_process_receives_from_its_senders_only(finished: Finished) -> None:
    import json

    reports = json.loads((finished.run_dir / "reports.json").read_text())
    at = {reports[role]["channel"]["local"]: role for role in reports}
    heard = {
        role: {at[source] for source in report["channel"]["received_from"]}
        for role, report in reports.items()
    }
    assert heard == {
        "plant": {"controller"},
        "sensor": {"plant", "netem"},
        "netem": {"sensor", "controller"},
        "controller": {"netem"},
    }
