"""A run that is read in many parts has the results of one that is read at once."""

from typing import Any

import pytest

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.replay import replay
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.record import run_record
from cosim.record.align import align_tables
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate

PART_ROWS = 37
NOISE = {"C": [[1.0, 0.0]], "noise_std": [0.02]}
ROUNDED = ("rms", "rms_second_half")
"""Sums: their last bits depend on the order of the terms."""


OBSERVED = pytest.param("observed", marks=pytest.mark.deep)
"""The bounds of a filter whose gains change for long take 20 s."""


@pytest.fixture(params=["plain", "disturbed", OBSERVED, "acknowledged", "changed"])
def record(request: pytest.FixtureRequest, content: dict[str, Any]) -> RunRecord:
    content |= {"horizon_s": 3.0}
    if request.param in ("disturbed", "observed"):
        content["plant"] |= {"disturbances": [{"kind": "gaussian", "std": [0.5]}]}
    if request.param == "observed":
        content["plant"]["measurement"] = NOISE
        content["observer"] = {"kind": "kalman", "initial_std": [0.4, 0.4]}
        content["trigger"] |= {"beta": 0.1, "floor": 0.1}
    if request.param == "acknowledged":
        content["network"] |= {"protocol": "ack"}
    if request.param == "changed":
        content["changes"] = [{"at_s": 1.0, "set": {"trigger.floor": 0.05}}]
    long_run = simulate(resolve(validate(content, "test")))
    assert len(long_run[PLANT_STEP]) > 5 * PART_ROWS
    return long_run


def results(record: RunRecord) -> dict[str, Any]:
    claims = RunClaims(record)
    return {
        "summary": summarise_loop(record, 0, "horizon").model_dump(mode="json"),
        "replay": replay(record).to_json(),
        "claims": [claim.model_dump(mode="json") for claim in claims.evaluate()],
        "conformance": [part.model_dump(mode="json") for part in claims.conformance()],
        "conditions": claims.largest_observed,
        "envelopes": [
            (curve.label, curve.t_s.tobytes(), curve.values.tobytes()) for curve in claims.envelopes()
        ],
        "inter_event_s": [
            passed_s
            for part in RunClaims(record).evidence.samples()
            for passed_s in part.inter_event_s[1].tolist()
        ],
        "aligned": [column.tobytes() for column in align_tables(record)],
    }


def without_sums(content: Any) -> Any:
    if isinstance(content, dict):
        return {k: without_sums(v) for k, v in content.items() if k not in ROUNDED}
    return [without_sums(entry) for entry in content] if isinstance(content, list) else content


def test_the_results_do_not_depend_on_the_parts(record: RunRecord, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = results(record)
    monkeypatch.setattr(run_record, "BATCH_ROWS", PART_ROWS)
    monkeypatch.setattr(RunRecord, "slice_columns", 10**6)
    in_parts = RunRecord(record.scenario, record.batches, record.notices, record.reports, "live")
    in_parts.kind = record.kind
    assert len(list(in_parts.slices())) > 5
    assert without_sums(results(in_parts)) == without_sums(whole)
