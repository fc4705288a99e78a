"""The end of a run: its record completed, its summary and report written."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cosim.analysis.claims.claim_definition import Envelope
from cosim.analysis.claims.claims_by_part import RunClaims
from cosim.analysis.fidelity import fidelity_for_summary
from cosim.analysis.loops_over_time import worst_loop
from cosim.analysis.loops_summary import LoopsSummary, has_loops, is_complete
from cosim.analysis.loss_statistics import list_violations
from cosim.analysis.model_comparison import linearisation
from cosim.analysis.replay import replay
from cosim.analysis.run_summary import Outcome, Summary, summarise
from cosim.analysis.summary_model import ReplayPart, RunSummary, SummaryPart
from cosim.live.finalize_loops import exit_after_replay, finalize_loops
from cosim.live.replay_process import ReplayProcess
from cosim.record.decimate import is_long
from cosim.record.loops_run import loop_directories
from cosim.record.run_directory import (
    ENDING_FILE,
    RECORD,
    RECORDING_FILE,
    REPORT_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    finished_run,
    read_object,
    refuse_links,
)
from cosim.record.run_ending import EndingFile, RunEnding
from cosim.record.run_record import RunRecord, load_record
from cosim.record.spool_conversion import finish_record
from noack.config.scenario_file import MOST_RECORDED_BYTES, load
from noack.core.errors import CallerError, ExitStatus, MachineError
from noack.core.file_access import write_whole
from noack.runtime.spool import SPOOL

_FEW_LOOPS = 4
"""The reports of up to so many loops are written at the end of the run."""


@np.errstate(all="ignore")
def finalize(
    ending: RunEnding, *, report: bool = True, again: bool = False, loops: int = 1
) -> Outcome:
    """Complete the record of a run; write its summary and report.

    Args:
        ending: how the run ended.
        report: whether to write the report.
        again: an earlier attempt may have been interrupted.
        loops: number of loops of the run, of which this is one.

    Raises:
        CallerError: the run is still under way.
        MachineError: record or summary cannot be written.
    """
    run_dir = ending.run_dir
    with _with_reason(ending), finished_run(run_dir), ExitStack() as stack:
        if not (scenario_file := run_dir / SCENARIO_FILE).exists():
            raise MachineError(f"{scenario_file}: no such file")  # the run directory was replaced
        unfinished = (run_dir / SPOOL).is_dir() or not (run_dir / RECORD).is_dir()
        sections = None
        if loops == 1:
            sections = load(scenario_file, most_bytes=MOST_RECORDED_BYTES).loops
        if sections is not None:
            count = sum(section.count for section in sections)
            few = report and count <= _FEW_LOOPS
            of_loop = partial(finalize, report=few, again=again, loops=count)
            network, shared = finalize_loops(ending, of_loop, unfinished=unfinished)
            return _finalize_loops(network, shared, ending, report=report)
        record = finish_record(run_dir) if unfinished else load_record(run_dir)
        replaying = stack.enter_context(ReplayProcess(record, run_dir))
        # A stopped recorder has no time to write the recording of a long run.
        needed = unfinished or (record.kind == "live" and is_long(record.scenario))
        shown = record.number is None or (report and not unfinished)
        if shown and (needed or (again and record.kind == "live")):
            from cosim.output.viewer.run_view import write_view

            # The recording of an earlier attempt may be complete.
            with suppress(*(() if needed else (MachineError,))):
                write_view(record, run_dir, ending.run_id)
        summary = summarise(record, int(ending.status), ending.reason, ending.startup_s)
        _write_summary(run_dir, summary)
        # Written again with the results below, so that none of them can cost the summary.
        claims = RunClaims(record)
        summary = _with_results(record, claims, summary, replaying, loops)
        _write_summary(run_dir, summary)
        status, reason = ExitStatus(summary.exit.status), summary.exit.reason
        if (ending.status, ending.reason) != (status, reason):
            _correct_ending(replace(ending, status=status, reason=reason))
        content = summary.to_json()
        if report:
            with _report_is_optional(run_dir):
                _report(record, content, run_dir, claims)
    return Outcome(run_dir, status, reason, content)


def _finalize_loops(
    network: RunRecord, summary: LoopsSummary, ending: RunEnding, *, report: bool
) -> Outcome:
    """Write summary, report and recording of a run of several loops, which are finalised."""
    _write_summary(ending.run_dir, summary)
    status, reason = ExitStatus(summary.exit.status), summary.exit.reason
    content = summary.model_dump(mode="json")
    if report:
        with _report_is_optional(ending.run_dir):
            _loops_report(network, content, ending.run_dir)
        try:
            from cosim.output.viewer.loops_view import write_loops_view

            write_loops_view(network, content, ending.run_dir, ending.run_id)
        except Exception as error:  # likewise
            print(f"noack: warning: no {RECORDING_FILE}: {error}", file=sys.stderr)
    return Outcome(ending.run_dir, status, reason, content)


@contextmanager
def _report_is_optional(run_dir: Path) -> Iterator[None]:
    """Warn if the report cannot be written, whatever the error is: the run is not affected."""
    try:
        yield
    except Exception as error:
        (run_dir / REPORT_FILE).unlink(missing_ok=True)
        print(f"noack: warning: no {REPORT_FILE}: {error}", file=sys.stderr)


def _correct_ending(ending: RunEnding) -> None:
    """Let the launcher's file agree with the summary."""
    if (ending.run_dir / ENDING_FILE).is_file():
        with suppress(MachineError), EndingFile(ending.run_dir) as file:
            file.store(ending.status, ending.reason, ending.startup_s)


@contextmanager
def _with_reason(ending: RunEnding) -> Iterator[None]:
    """Add the reason of a failed run to an error that prevents the completion of its record."""
    try:
        yield
    except MachineError as error:
        if ending.status == ExitStatus.OK:
            raise
        raise MachineError(f"the run failed: {ending.reason}\n{error}") from None


def _write_summary(run_dir: Path, summary: SummaryPart) -> None:
    try:
        text = summary.model_dump_json(indent=2)
        write_whole(run_dir / SUMMARY_FILE, text, make_folder=False)
    except MachineError as error:
        raise MachineError(f"{error}; try `noack summary {run_dir}` later") from None


def _with_results(
    record: RunRecord, claims: RunClaims, summary: RunSummary, replaying: ReplayProcess, loops: int
) -> RunSummary:
    """Add the results of replay, fidelity and claims; a failure of one is a line or a warning."""
    results: dict[str, Any] = {"fidelity": fidelity_for_summary(record, loops)}
    try:
        results["linearisation"] = linearisation(record.scenario)
    except Exception as error:  # likewise
        print(f"noack: warning: the plant was not linearised: {error!r}", file=sys.stderr)
    try:
        violations = list_violations(summary.assumption_violations, claims.violations())
        longest = summary.longest_loss_burst
        if summary.unintended_losses:
            longest = max(longest, int(claims.conditions["dropouts"] or 0))
        results |= {
            "conditions": claims.conditions,
            "claims": claims.judge(),
            "judged_until_s": claims.judged_until_s,
            "assumption_violations": violations,
            "longest_loss_burst": longest,
        }
    except Exception as error:  # likewise
        print(f"noack: warning: the claims were not judged: {error!r}", file=sys.stderr)
    if record.kind == "live":
        try:
            results["replay"] = replaying.verdict() or replay(record).verdict()
        except Exception as error:  # the run itself did not fail
            results["replay"] = {"bit_exact": None, "error": repr(error)}
        results["exit"] = exit_after_replay(summary.exit, ReplayPart(**results["replay"]))
    return summary.with_results(**results)


def reopen(run_dir: Path) -> Outcome:
    """Return the outcome of an earlier run; complete its record and summary if necessary.

    Raises:
        CallerError: it is not a run directory, or the run is still under way.
    """
    if not (run_dir / SCENARIO_FILE).is_file():
        raise CallerError(f"{run_dir}: not a run directory (no {SCENARIO_FILE})")
    summary = read_object(run_dir / SUMMARY_FILE)
    ending = _ending(run_dir, summary)
    # A process that was frozen may have spooled rows after the end.
    if ending is not None and is_complete(summary) and not (run_dir / SPOOL).is_dir():
        return Outcome(run_dir, ending.status, ending.reason, summary)
    # A summary of several loops is failed if one of them failed; the others did not.
    if ending is None or has_loops(summary):
        ending = _ending(run_dir, read_object(run_dir / ENDING_FILE))
    refuse_links(run_dir)
    unknown = RunEnding(run_dir, 0, ExitStatus.FAILED, "the launcher ended early")
    return finalize(ending or unknown, again=True)


def _ending(run_dir: Path, found: Mapping[str, Any]) -> RunEnding | None:
    """Return how a run ended by its summary or its launcher's file; None if it is not there."""
    with suppress(LookupError, TypeError, ValueError):
        status, reason = ExitStatus(found["exit"]["status"]), str(found["exit"]["reason"])
        return RunEnding(run_dir, 0, status, reason, found["startup_s"])
    return None


@np.errstate(all="ignore")
def run_report(run_dir: Path, *, again: bool = False) -> Path:
    """Return the path of an earlier run's report; write it if it is missing, or ``again``.

    Raises:
        CallerError: it is not a run directory, or the run is still under way.
        MachineError: the report cannot be written.
    """
    outcome, path = reopen(run_dir), run_dir / REPORT_FILE
    if path.is_file() and not again:
        return path
    record = load_record(run_dir, network=True)
    if record.is_network:
        return _loops_report(record, outcome.summary, run_dir)
    return _report(record, outcome.summary, run_dir, RunClaims(record))


def write_recording(run_dir: Path) -> None:
    """Write the recording of an earlier run, or of one of its loops.

    Raises:
        CallerError: it is not a run directory, or the run is still under way.
        MachineError: the recording cannot be written.
    """
    outcome, record = reopen(run_dir), load_record(run_dir, network=True)
    run_id = (record.number or 0) + 1  # the viewer knows recordings by it
    if record.is_network:
        from cosim.output.viewer.loops_view import write_loops_view

        write_loops_view(record, outcome.summary, run_dir, run_id)
    else:
        from cosim.output.viewer.run_view import write_view

        write_view(record, run_dir, run_id)


def _report(record: RunRecord, summary: Summary, run_dir: Path, claims: RunClaims) -> Path:
    from cosim.output.report.report_page import write_report  # imports matplotlib

    return write_report(record, summary, run_dir, _envelopes(claims))


def _loops_report(network: RunRecord, summary: Summary, run_dir: Path) -> Path:
    from cosim.output.report.loops_page import write_loops_report  # imports matplotlib

    number = worst_loop(run_dir, summary["loops"]).number
    worst = load_record(loop_directories(run_dir, network.scenario)[number])
    return write_loops_report(network, summary, run_dir, _envelopes(RunClaims(worst)))


def _envelopes(claims: RunClaims) -> Sequence[Envelope]:
    try:
        return claims.envelopes()
    except Exception:  # the report is useful without them
        return []
