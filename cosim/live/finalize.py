"""The end of a run: its record completed, its summary and report written."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from cosim.analysis.claims.claim import as_json
from cosim.analysis.claims.claims_by_part import RunClaims
from cosim.analysis.fidelity import fidelity_for_summary
from cosim.analysis.model_comparison import linearisation
from cosim.analysis.replay import replay
from cosim.analysis.run_outcome import Outcome
from cosim.analysis.run_summary import Summary, dumps, summarise
from cosim.analysis.summary_check import can_be_shown
from cosim.record.run_directory import (
    ENDING_FILE,
    RECORD,
    REPORT_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    finished_run,
    read_object,
)
from cosim.record.run_ending import EndingFile, RunEnding
from cosim.record.run_record import RunRecord, finish_record, load_record
from noack.core.errors import CallerError, ExitStatus, MachineError, why
from noack.runtime.spool import SPOOL


@np.errstate(all="ignore")
def finalize(ending: RunEnding, *, report: bool = True) -> Outcome:
    """Complete the record of a run; write its summary and report.

    Args:
        ending: how the run ended.
        report: whether to write the report.

    Raises:
        CallerError: the run is still under way.
        MachineError: record or summary cannot be written.
    """
    run_dir = ending.run_dir
    with _with_reason(ending), finished_run(run_dir):
        if (run_dir / SPOOL).is_dir() or not (run_dir / RECORD).is_dir():
            record = finish_record(run_dir)
            from cosim.output.viewer.run_view import write_view

            write_view(record, run_dir, ending.run_id)
        else:
            record = load_record(run_dir)
        summary = summarise(record, int(ending.status), ending.reason, ending.startup_s)
        summary |= {"replay": None, "fidelity": None, "claims": [], "conditions": None}
        summary["judged_until_s"] = None
        _write_summary(run_dir, summary)
        # Written before and after: a failure in the analysis must not cost the summary.
        claims = RunClaims(record)
        summary |= _analysis(record, claims, summary)
        summary["exit"] = end = _end(summary)
        _write_summary(run_dir, summary)
        if (int(ending.status), ending.reason) != (end["status"], end["reason"]):
            _correct_ending(run_dir, end, ending.startup_s)
        try:
            if report:
                _report(record, summary, run_dir, claims)
        except Exception as error:  # whatever it is, the run itself is not affected
            (run_dir / REPORT_FILE).unlink(missing_ok=True)
            print(f"noack: warning: no {REPORT_FILE}: {error}", file=sys.stderr)
    return Outcome(run_dir, ExitStatus(end["status"]), end["reason"], summary)


def _correct_ending(run_dir: Path, end: Mapping[str, Any], startup_s: float | None) -> None:
    """Let the launcher's file agree with the summary."""
    if (run_dir / ENDING_FILE).is_file():
        with suppress(MachineError), EndingFile(run_dir) as file:
            file.store(ExitStatus(end["status"]), end["reason"], startup_s)


@contextmanager
def _with_reason(ending: RunEnding) -> Iterator[None]:
    """Add the reason of a failed run to an error that prevents the completion of its record."""
    try:
        yield
    except MachineError as error:
        if ending.status == ExitStatus.OK:
            raise
        raise MachineError(f"the run failed: {ending.reason}\n{error}") from None


def _write_summary(run_dir: Path, summary: Summary) -> None:
    path = run_dir / SUMMARY_FILE
    scratch = path.with_suffix(".partial")
    try:
        scratch.write_text(dumps(summary), encoding="utf-8")
        scratch.replace(path)
    except OSError as error:
        with suppress(OSError):
            scratch.unlink(missing_ok=True)
        raise MachineError(
            f"{path}: cannot be written: {why(error)}; try `noack summary {run_dir}` later"
        ) from None


def _analysis(record: RunRecord, claims: RunClaims, summary: Summary) -> Summary:
    """Replay, fidelity, linearisation and claims; a failure of one is a line in the summary."""
    found: Summary = {}
    if record.kind == "live":
        try:
            found["replay"] = replay(record).verdict()
        except Exception as error:  # whatever it is, the run itself is not affected
            found["replay"] = {"bit_exact": None, "error": repr(error)}
    found["fidelity"] = fidelity_for_summary(record)
    try:
        if (near := linearisation(record.scenario)) is not None:
            found["linearisation"] = near
    except Exception as error:  # likewise
        print(f"noack: warning: the plant was not linearised: {error!r}", file=sys.stderr)
    try:
        found |= {"conditions": claims.conditions, "claims": as_json(claims.judge())}
        found["judged_until_s"] = claims.judged_until_s
        found |= _unseen_losses(claims, summary)
    except Exception as error:  # likewise
        print(f"noack: warning: the claims were not judged: {error!r}", file=sys.stderr)
    return found


def _end(summary: Summary) -> dict[str, Any]:
    """How the run ended; a run that cannot be replayed has failed."""
    end: dict[str, Any] = summary["exit"]
    verdict = summary["replay"]
    if end["status"] != ExitStatus.OK or verdict is None or verdict["bit_exact"] is not None:
        return end
    why = verdict.get("error", "the record has no inputs")
    return {"status": int(ExitStatus.FAILED), "reason": f"the run cannot be replayed: {why}"}


def _unseen_losses(claims: RunClaims, summary: Summary) -> Summary:
    """Loss bursts while a process was away, which emulator and controller did not count."""
    longest = int(claims.conditions["dropouts"] or 0)
    if not summary["lost_outside_netem"] or longest <= summary["longest_loss_burst"]:
        return {}
    found: Summary = {"longest_loss_burst": longest}
    if (beyond := claims.mansd_violation) is not None and not summary["assumption_violations"]:
        at_s, what = beyond
        found["assumption_violations"] = [
            {"t_s": at_s, "process": "recorder", "what": f"MANSD violated: {what}"}
        ]
    return found


def reopen(run_dir: Path) -> Outcome:
    """Return the outcome of an earlier run; complete its record and summary if necessary.

    Raises:
        CallerError: it is not a run directory, or the run is still under way.
    """
    if not (run_dir / SCENARIO_FILE).is_file():
        raise CallerError(f"{run_dir}: not a run directory (no {SCENARIO_FILE})")
    summary = read_object(run_dir / SUMMARY_FILE)
    ending = _ending(run_dir, summary)
    # The summary is missing or damaged; or a process that was frozen spooled rows after the end.
    if not can_be_shown(summary) or (run_dir / SPOOL).is_dir():
        return finalize(ending)
    return Outcome(run_dir, ending.status, ending.reason, summary)


def _ending(run_dir: Path, summary: Summary) -> RunEnding:
    """How a run ended, from its summary or else from its launcher's file."""
    for found in (summary, read_object(run_dir / ENDING_FILE)):
        with suppress(LookupError, TypeError, ValueError):
            status, reason = ExitStatus(found["exit"]["status"]), str(found["exit"]["reason"])
            return RunEnding(run_dir, 0, status, reason, found["startup_s"])
        summary.clear()  # a summary without an exit cannot be trusted
    return RunEnding(run_dir, 0, ExitStatus.FAILED, "the launcher ended early")


@np.errstate(all="ignore")
def rewrite_report(run_dir: Path) -> Path:
    """Write the report of an earlier run again, and return its path.

    Raises:
        CallerError: it is not a run directory, or the run is still under way.
        MachineError: the report cannot be written.
    """
    outcome = reopen(run_dir)
    record = load_record(run_dir)
    return _report(record, outcome.summary, run_dir, RunClaims(record))


def _report(record: RunRecord, summary: Summary, run_dir: Path, claims: RunClaims) -> Path:
    from cosim.output.report.report_file import (
        write_report,  # imports matplotlib
    )

    try:
        envelopes = claims.envelopes()
    except Exception:  # the report is useful without them
        envelopes = []
    return write_report(record, summary, run_dir, envelopes)
