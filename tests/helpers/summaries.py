"""Records and summaries of runs of one loop for tests."""

from typing import Any

from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.run_summary import summarise_run
from cosim.analysis.summary.summary_model import ExitPart, LoopSummary, RunSummary
from cosim.record.run_record import NETWORK_ROLES, RecordedRun, RunRecord
from noack.scenario.resolution import ResolvedRun


def run_of_one_loop(record: RunRecord) -> RecordedRun:
    """Return the record of a run whose only loop has the network for itself."""
    network = RunRecord(record.scenario, record.batches, [], record.reports, record.kind, roles=NETWORK_ROLES)
    return RecordedRun(ResolvedRun(record.scenario, (record.scenario,)), network, lambda _: [record])


def summary_of(record: RunRecord, **more: Any) -> RunSummary:
    """The summary of a completed run whose only loop has this record, with other values."""
    end = ExitPart(status=0, reason="horizon")
    run = summarise_run(run_of_one_loop(record).network, [summarise_loop(record, 0, "horizon")], end)
    return with_values(run, **more)


def with_values(run: RunSummary, **more: Any) -> RunSummary:
    """The summary of one loop with other values of the run or of its loop, given as JSON."""
    document: dict[str, Any] = run.to_json()
    (loop,) = document["loops"]
    unknown = more.keys() - RunSummary.model_fields.keys() - LoopSummary.model_fields.keys()
    assert not unknown, unknown
    for part, model in ((loop, LoopSummary), (document, RunSummary)):
        part |= {key: value for key, value in more.items() if key in model.model_fields}
    return RunSummary.model_validate(document)


def claim(verdict: str, **more: Any) -> dict[str, Any]:
    """A claim about a loop, in the form of the summary."""
    return {
        "what": "a", "kind": "certificate", "source": "certificate", "bound": "c", "ratio": 1.0,
        "since_s": 1.0,
        "verdict": verdict, "certified": 1.0, "observed": 1.0, "until_s": None, **more,
    }  # fmt: skip
