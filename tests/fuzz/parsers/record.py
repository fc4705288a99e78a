"""Run directories, of which files are edited, damaged or missing; and messages to the recorder."""

import io
import json
import shutil
from collections.abc import Mapping
from contextlib import redirect_stderr
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq
from rich.console import Console

from cosim.analysis.replay import replay
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.run_summary import Outcome, summarise_run
from cosim.analysis.summary.summary_model import ExitPart, LoopSummary
from cosim.live.finalize import reopen
from cosim.live.recording.recorder import Recorder
from cosim.output.run_document import run_document
from cosim.record.record_writing import write_run
from cosim.record.rows import with_loop
from cosim.record.run_directory import (
    ENVIRONMENT_FILE,
    RECORD,
    SCENARIO_FILE,
    SUMMARY_FILE,
    RunEnding,
    changed_since,
    environment,
)
from cosim.record.run_record import Rows, RunRecord, load_record
from cosim.record.spool_conversion import finish_record
from cosim.simulation.virtual_time import simulate
from netem.output.terminal_writer import print_document
from noack.protocol.record_tables import OWNER
from noack.runtime.spool import NOTICES, SPOOL, SpoolWriter, batch_of, notices_of
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.scenario_file import dumps, validate
from tests.fuzz.edits import Choices, Vocabulary, damaged, edited, edited_table, written
from tests.fuzz.harness import refusal, workspace
from tests.fuzz.plane import FakePlane, Query, Sample
from tests.helpers.summaries import run_of_one_loop

SCENARIO = {
    "name": "short", "horizon_s": 0.05, "model": {"name": "double_integrator"},
    "plant": {"initial_state": [1.0, 0.0], "rate_hz": 200.0},
    "controller": {"rate_hz": 200.0},
    "trigger": {"beta": 0.01, "alpha_per_s": 0.25},
    "network": {"mansd": 1, "loss": {"model": "bernoulli", "probability": 0.5}},
}  # fmt: skip
NOTICE = {"t_ns": 10_000_000, "level": "violation", "text": "MANSD violated", "process": "netem"}
CLAIM = {
    "what": "the error is bounded", "kind": "paper", "source": "Theorem 1", "bound": "‖e‖ ≤ 1",
    "certified": 1.0, "observed": 0.5, "ratio": 0.5, "verdict": "ended", "since_s": 0.01,
    "cause": "watchdog", "detail": "", "until_s": None,
}  # fmt: skip
IDEAL_LOOP = {"reason": None, "rms_difference": 0.1, "rms_x": 1.0, "events": 1}
RECORD_KNOWN = Vocabulary(
    ("rows", "ended", "channel", "rejected", "acknowledgements", "realtime", "pid", "plant",
     "netem", "plant_step", "netem_packet", "t_ns", "level", "text", "process", "kind"),
    ("horizon", "violation", "live", "simulated", "plant", "tag", ""),
)  # fmt: skip


def spooled(record: RunRecord, table: str) -> Rows:
    """The rows of a table as its process spools them."""
    return with_loop(record[table], 0, ResolvedRun(record.scenario).tables[table])


@cache
def files(acknowledged: bool, live: bool) -> Mapping[str, bytes]:
    """Return the files of a recorded run, by name."""
    content: dict[str, Any] = json.loads(json.dumps(SCENARIO))
    if acknowledged:
        content["network"]["protocol"] = "ack"
    resolved = resolve(validate(content, "short"))
    record = simulate(resolved)
    record.notices.append(dict(NOTICE))
    folder = workspace() / f"short-{acknowledged}-{live}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / SCENARIO_FILE).write_text(dumps(resolved))
    reports = {
        role: {**report, "pid": 1, "realtime": {"sched_fifo": "applied"}} if live else report
        for role, report in record.reports.items()
    }
    kind = "live" if live else "simulated"
    run = run_of_one_loop(
        RunRecord(resolved, record.batches, record.notices, reports, "live" if live else "simulated")
    )
    own = summarise_loop(run.loop(), 0, "finished").to_json()
    own |= {
        "replay": replay(record).verdict().model_dump(),
        "claims": [CLAIM],
        "ideal_loop": IDEAL_LOOP,
    }
    end, loop = ExitPart(status=0, reason="finished"), LoopSummary.model_validate(own)
    summary = summarise_run(run.network, [loop], end).to_json()
    (folder / SUMMARY_FILE).write_text(json.dumps(summary))
    (folder / ENVIRONMENT_FILE).write_text(json.dumps(environment(kind) | {"command": []}))
    write_run(run, folder)
    writer = SpoolWriter(folder / SPOOL, "recorder")
    for table in record.tables:
        rows = spooled(record, table)
        for begin in range(0, len(rows), 4):
            writer.append(table, begin, rows[begin : begin + 4].tobytes())
    for number in range(2):
        writer.append(notices_of("netem"), number, json.dumps(NOTICE).encode())
    writer.close()
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def record_input(choices: Choices) -> None:
    """A damaged run directory is refused, or every command can show it."""
    content = dict(files(choices.flag(), choices.flag()))
    stage = choices.below(3)  # 0 recorded, 1 interrupted, 2 recorded with rows left in the spool
    for name in list(content):
        if (name.startswith(RECORD) and stage == 1) or (name.startswith(SPOOL) and stage == 0):
            del content[name]
    whole = list(content)
    for _ in range(choices.below(4)):
        whole.remove(name := choices.choose(whole))
        changed = _changed(choices, name, content[name])
        if changed is None:
            del content[name]
        else:
            content[name] = changed
    run_dir = workspace() / "run"
    shutil.rmtree(run_dir, ignore_errors=True)
    for name, data in content.items():
        (run_dir / name).parent.mkdir(parents=True, exist_ok=True)
        (run_dir / name).write_bytes(data)
    with refusal(lines=True):
        _show(run_dir)
        _read(run_dir)


def _changed(choices: Choices, name: str, data: bytes) -> bytes | None:
    """Return the changed content of a file; None removes it."""
    kind = choices.below(4)
    if kind == 0 and name != SCENARIO_FILE:
        return None if choices.flag() else damaged(choices, data)
    if name.endswith(".parquet"):
        return written(choices, edited_table(choices, _table(data)), {})
    if name.endswith((".json", ".jsonl")) and kind != 1:
        lines = data.splitlines() if name.endswith("l") else [data]
        lines = [edited(choices, json.loads(line), RECORD_KNOWN) for line in lines]
        return b"".join(json.dumps(line).encode() + b"\n" for line in lines)
    if name.startswith(SPOOL) and kind != 1:
        return _spool(choices, name, data)
    return damaged(choices, data) if name != SCENARIO_FILE else data


def _table(data: bytes) -> Any:
    path = workspace() / "base.parquet"
    path.write_bytes(data)
    return pq.read_table(path)


def _spool(choices: Choices, name: str, data: bytes) -> bytes:
    """Return a spool file with changed row numbers or an additional chunk."""
    if "notices" in name:
        payload = json.dumps(edited(choices, NOTICE, RECORD_KNOWN)).encode()
    else:
        numbers = np.frombuffer(data[16 : 16 + (len(data) - 16) // 8 * 8], "<i8").copy()
        for _ in range(choices.below(4)):
            numbers[choices.below(len(numbers))] = int(np.int64(choices.integer() % 2**63))
        payload = numbers.tobytes()[: choices.choose([len(data) - 16, 0, 8, 33])]
    head = choices.integer() % 2**64, choices.choose([len(payload), choices.integer() % 2**64])
    chunk = np.array(head, "<u8").tobytes() + payload
    return data + chunk if choices.flag() else chunk


def _show(run_dir: Path) -> None:
    """Process an existing summary as `noack summary` does."""

    def finalize(ending: RunEnding, *, view: bool, again: bool) -> Outcome:
        assert view
        assert again
        assert isinstance(ending.reason, str)
        return Outcome(run_dir, ending.status, ending.reason, None)  # type: ignore[arg-type]

    with patch("cosim.live.finalize.finalize", finalize):
        outcome = reopen(run_dir)
    changed_since(run_dir)
    if outcome.summary is not None:
        print_document(Console(file=io.StringIO(), width=80), run_document(outcome))


def _read(run_dir: Path) -> None:
    """Read a run directory as the commands on runs do."""
    cut_short = (run_dir / SPOOL).is_dir() or not (run_dir / RECORD).is_dir()
    record = finish_record(run_dir).loop() if cut_short else load_record(run_dir)
    json.loads(summarise_loop(record, 0, "finished").model_dump_json())
    replayed = replay(record)
    replayed.verdict().model_dump_json()
    json.dumps(replayed.to_json())
    if cut_short:
        again = load_record(run_dir)  # a finalised record can be read
        assert all(record[table].tobytes() == again[table].tobytes() for table in record.tables)
        assert record.notices == again.notices


RESOLVED = resolve(validate(SCENARIO, "short"))
REPORT = {
    "pid": 1, "ended": "horizon", "realtime": {},
    "channel": {"accepted": 1, "rejected": {"tag": 1}},
    "rows": {"plant_step": 4, "plant_actuation": 0, "notices": 1},
    "instance": "one",
}  # fmt: skip
_TYPES = ResolvedRun(RESOLVED).tables
HEADER = {"first": 0, "rows": 4}
TELEMETRY_KNOWN = Vocabulary(
    (*REPORT, *HEADER, *NOTICE, *OWNER, "accepted", "rejected"), (*OWNER, "horizon", "violation")
)


def telemetry_input(choices: Choices) -> None:
    """The recorder takes any messages; the valid part of them is the record."""
    run_dir = workspace() / "telemetry"
    shutil.rmtree(run_dir, ignore_errors=True)
    run_dir.mkdir()
    (run_dir / SCENARIO_FILE).write_text(dumps(RESOLVED))
    messages: list[tuple[str, Query | Sample]] = []
    for _ in range(1 + choices.below(6)):
        match choices.below(5):
            case 0:
                messages.append(("report", _report(choices)))
            case 1:
                alive = Sample(f"noack/0/alive/{choices.choose([*OWNER.values(), ''])}/one")
                messages.append(("alive", alive))
            case _:
                messages.append(("telemetry", _batch(choices)))
    plane = FakePlane()
    recorder = Recorder(ResolvedRun(RESOLVED), run_dir, plane)
    for key, message in messages:
        plane.put(key, message)
    queries = [message for _, message in messages if isinstance(message, Query)]
    with redirect_stderr(io.StringIO()) as errors:
        recorder.poll()
    assert errors.getvalue().count("\n") <= 1, "invalid messages fill the log"
    recorder.show()
    recorder.acknowledge()
    assert isinstance(recorder.finished, bool)
    assert all(query.answered == 1 for query in queries), "a report has no answer"
    # The record contains the valid part of the messages.
    recorder.finish()
    recorder.report()
    record = finish_record(run_dir).loop()
    assert set(record.tables) >= {"plant_step"}


def _batch(choices: Choices) -> Sample:
    table = choices.choose([*OWNER, NOTICES, "", "nothing"])
    role = choices.choose([OWNER.get(table, "plant"), "nobody"])
    if table == NOTICES:
        lines = [edited(choices, NOTICE, TELEMETRY_KNOWN) for _ in range(1 + choices.below(3))]
        payload = batch_of(json.dumps(line).encode() for line in lines)
    else:
        count = choices.below(3)
        numbers = [choices.integer() % 2**63 if choices.below(4) == 0 else 0 for _ in range(8)]
        payload = np.resize(np.array(numbers, "<i8"), 64 * count).tobytes()
        types = _TYPES.get(table)
        if types is not None and choices.below(4):
            payload = payload[: types.itemsize * choices.below(4)]
    header = json.dumps(edited(choices, HEADER, TELEMETRY_KNOWN)).encode()
    attachment = None if choices.below(8) == 1 else damaged(choices, header)
    payload = damaged(choices, payload) if payload else payload
    return Sample(f"noack/0/telemetry/{role}/{table}", payload, attachment)


def _report(choices: Choices) -> Query:
    report: Any = edited(choices, REPORT, TELEMETRY_KNOWN)
    payload = None if choices.below(8) == 1 else damaged(choices, json.dumps(report).encode())
    return Query(f"noack/0/report/{choices.choose([*OWNER.values(), 'nobody'])}", payload)


PARSERS = {
    "record": record_input,
    "telemetry": telemetry_input,
}
