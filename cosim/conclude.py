"""The conclusion of a run: its record made whole, its summary written."""

import json
from dataclasses import dataclass
from pathlib import Path

from cosim.launch import Ending
from cosim.record import finish_record, load_record
from cosim.run_dir import RECORD, SCENARIO_FILE, SPOOL, SUMMARY_FILE
from cosim.summary import Summary, dumps, summarise
from noack.errors import CallerError, ExitStatus


@dataclass(frozen=True)
class Outcome:
    """What became of a run."""

    run_dir: Path
    status: ExitStatus
    reason: str
    summary: Summary


def conclude(ending: Ending) -> Outcome:
    """Finish what a dead recorder left undone, and write the summary."""
    run_dir = ending.run_dir
    if (run_dir / SPOOL).is_dir() or not (run_dir / RECORD).is_dir():
        record = finish_record(run_dir)
        from cosim.recorder import write_view  # imports rerun, which a good run does not need here

        write_view(record, run_dir, ending.run_id)
    else:
        record = load_record(run_dir)
    summary = {"startup_s": ending.startup_s} | summarise(record, int(ending.status), ending.reason)
    (run_dir / SUMMARY_FILE).write_text(dumps(summary))
    return Outcome(run_dir, ending.status, ending.reason, summary)


def reopen(run_dir: Path) -> Outcome:
    """Return the outcome of an earlier run; finish its record if nobody did.

    Raises:
        CallerError: it is not a run directory.
    """
    if not (run_dir / SCENARIO_FILE).is_file():
        raise CallerError(f"{run_dir}: not a run directory (no {SCENARIO_FILE})")
    path = run_dir / SUMMARY_FILE
    if not path.is_file():
        reason = "the launcher did not live to see the end"
        return conclude(Ending(run_dir, 0, ExitStatus.FAILED, reason))
    summary = json.loads(path.read_text())
    end = summary["exit"]
    return Outcome(run_dir, ExitStatus(end["status"]), end["reason"], summary)
