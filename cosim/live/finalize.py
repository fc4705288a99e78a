"""The end of a run, live or simulated: its record completed, its summary, report and recording written.

Read :func:`finalize` first. ``_evaluate_loops`` has what is found out about each loop; its claims are
judged in ``cosim/analysis/claims/``, whose package lists the files in the order to read.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from cosim.analysis.claims.claim_evaluation import RunClaims, claims_of
from cosim.analysis.claims.run_certificates import (
    RunCertificate,
    certificates_key,
    expected_certificates,
    search_limit,
)
from cosim.analysis.conformance.recorded_loop import MOST_STEPS
from cosim.analysis.ideal_loop import ideal_loop_part
from cosim.analysis.replay.machine_replay import SharedMachines
from cosim.analysis.replay.run_replay import replay
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.analysis.summary.loops_over_time import LoopOverTime, loop_over_time
from cosim.analysis.summary.plant_linearisation import linearisation
from cosim.analysis.summary.run_summary import Outcome, summarise_run
from cosim.analysis.summary.summary_model import (
    AllowedConditionsPart,
    ConditionsPart,
    ExitPart,
    LoopSummary,
    ReplayPart,
    RunSummary,
    read_summary,
)
from cosim.live.monitoring.progress import work_bar
from cosim.live.processes.early_certificates import LaunchedEnding
from cosim.live.processes.process_pool import map_in, processes
from cosim.output.viewer.rerun_program import require_viewer
from cosim.record.run_directory import (
    ENDING_FILE,
    RECORD,
    RECORDING_FILE,
    REPORT_FILE,
    REPORTS_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    RunEnding,
    file_of_loop,
    finished_run,
    read_object,
    refuse_links,
    require_run_directory,
)
from cosim.record.run_record import RecordedRun, RunRecord, load_run, resolved_run
from cosim.record.spool_conversion import finish_record
from netem.core.errors import CallerError, ExitStatus, MachineError
from netem.core.file_access import remove_file, write_whole
from netem.core.system_processes import cores
from noack.runtime.spool import SPOOL
from noack.theory.certificates.conditions import NetworkConditions

_FEW_LOOPS = 4
"""A run with at most this number of loops also gets one report per loop."""
_LEAST_LOOPS = 8
"""Smallest number of loops that are evaluated together."""
_LEAST_STEPS = 250
"""Each loop of a run has so many steps compared with its loop document in all numbers."""
_MANY_STEPS = 50_000
"""Loops with fewer steps of the plant, all together, are evaluated in less time than processes
start."""
Certificates = Sequence[RunCertificate]
Item = TypeVar("Item")
Result = TypeVar("Result")


@np.errstate(all="ignore")
def finalize(ending: RunEnding, *, report: bool = True, view: bool = True, again: bool = False) -> Outcome:
    """Complete the record of a run; write its summary, its report and its recording.

    Args:
        ending: how the run ended.
        report: whether to write the report.
        view: whether to write the recording, unless the recorder of the run has written it.
        again: an earlier attempt may have been interrupted.

    Raises:
        CallerError: the run is still under way.
        MachineError: record or summary cannot be written.
    """
    run_dir = ending.run_dir
    with _with_reason(ending), finished_run(run_dir):
        if not (scenario_file := run_dir / SCENARIO_FILE).exists():
            raise MachineError(f"{scenario_file}: no such file; the run directory was deleted or replaced")
        is_complete = not (run_dir / SPOOL).is_dir() and (run_dir / RECORD).is_dir()
        # A recorder that completed its recording writes the reports afterwards.
        is_recorded = is_complete or (run_dir / REPORTS_FILE).is_file()
        is_recorded = is_recorded and (run_dir / RECORDING_FILE).is_file()
        with _processes(run_dir) as pool:
            if is_complete:
                run = load_run(run_dir)
            else:
                run = finish_record(run_dir, partial(_map, pool, "the record of the run"))
            summary, over_time = _evaluate_run(run, ending, pool)
        _write_summary(run_dir, summary)
        if view:
            _write_recording_if_missing(
                run, summary, run_dir, over_time, is_recorded=is_recorded, again=again
            )
        if report:
            _write_reports(run, summary, run_dir, over_time)
    return Outcome(run_dir, ExitStatus(summary.exit.status), summary.exit.reason, summary)


@contextmanager
def _processes(run_dir: Path) -> Iterator[ProcessPoolExecutor | None]:
    """Have processes on all cores for the loops of a long run; None if this one needs no help."""
    run = resolved_run(run_dir)
    timing, workers = run.scenario.timing, min(cores(), len(run.names))
    is_long = len(run.names) * timing.horizon_ns >= _MANY_STEPS * timing.plant_period_ns
    with processes(workers) if is_long and workers > 1 else nullcontext() as pool:
        yield pool


def _map(
    pool: ProcessPoolExecutor | None, text: str, function: Callable[[Item], Result], items: Sequence[Item]
) -> Iterator[Result]:
    """Return ``function(item)`` of each item in order, see :func:`map_in`; show how many are computed."""
    return _shown(text, map_in(pool, function, items), len(items))


def _shown(text: str, results: Iterable[Result], count: int) -> Iterator[Result]:
    with work_bar(text, lines=True) as show:
        for number, result in enumerate(results, 1):
            show(number / count)
            yield result


def _write_recording_if_missing(
    run: RecordedRun,
    summary: RunSummary,
    run_dir: Path,
    over_time: Sequence[LoopOverTime] | None,
    *,
    is_recorded: bool,
    again: bool,
) -> None:
    """Write the recording of the run, unless the recorder has written it.

    That of an earlier attempt may be complete: it stays if there is no space for another.
    """
    if is_recorded and not again:
        return
    quiet = (MachineError,) if is_recorded else ()
    with _warning_if_not_written(run_dir / RECORDING_FILE), suppress(*quiet):
        require_viewer()
        _write_recording(run, summary, run_dir, None, over_time)


def _write_reports(
    run: RecordedRun, summary: RunSummary, run_dir: Path, over_time: Sequence[LoopOverTime] | None
) -> None:
    """Write the report of the run, and those of a few loops."""
    names = run.names if 1 < len(run.names) <= _FEW_LOOPS else []
    for name in (*names, None):
        with _warning_if_not_written(run_dir / file_of_loop(REPORT_FILE, name)):
            _write_report(run, summary, run_dir, name, over_time)


@contextmanager
def _warning_if_not_written(path: Path) -> Iterator[None]:
    """Warn if a file cannot be written, whatever the error is: the run is not affected."""
    try:
        yield
    except Exception as error:
        remove_file(path)
        print(f"noack: warning: no {path.name}: {error}", file=sys.stderr)


@contextmanager
def _with_reason(ending: RunEnding) -> Iterator[None]:
    """Add the reason of a failed run to an error that prevents the completion of its record."""
    try:
        yield
    except MachineError as error:
        if ending.status == ExitStatus.OK:
            raise
        raise MachineError(f"the run failed: {ending.reason}\n{error}") from None


def _write_summary(run_dir: Path, summary: RunSummary) -> None:
    try:
        text = summary.model_dump_json(indent=2)
        write_whole(run_dir / SUMMARY_FILE, text, make_folder=False)
    except MachineError as error:
        raise MachineError(f"{error}; try `noack summary {run_dir}` later") from None


class _LoopResults(NamedTuple):
    """What the end of a run finds out about a loop."""

    summary: LoopSummary
    over_time: LoopOverTime | None
    """Only of several loops; None if it could not be computed."""


def _evaluate_run(
    run: RecordedRun, ending: RunEnding, pool: ProcessPoolExecutor | None
) -> tuple[RunSummary, Sequence[LoopOverTime] | None]:
    """Evaluate every loop and the network; return the summary of the run, and how each loop went."""
    loops, replayed = len(run.names), None
    text = "checking claims" if loops == 1 else f"checking claims of {loops} loops"
    known = ending.certificates if isinstance(ending, LaunchedEnding) else {}
    bare = RunEnding(ending.run_dir, ending.run_id, ending.status, ending.reason, ending.startup_s)
    evaluate = partial(_evaluate_loops, run if pool is None else None, bare)
    blocks = [{number: known.get(number) for number in block} for block in _blocks(run)]
    by_block = _map(pool, text, evaluate, blocks)
    if run.kind == "live" and run.has_own_network:
        replayed = _replay(run.network)
    results = [loop for block in by_block for loop in block]
    summary = _summary(run, ending, [loop.summary for loop in results])
    if replayed is not None:
        network = summary.network.model_copy(update={"replay": replayed})
        summary = summary.model_copy(update={"network": network})
        if replayed.error is not None:
            end = _exit_after_replay(summary.exit, replayed)
            summary = summary.model_copy(update={"exit": end})
    over_time = [loop.over_time for loop in results if loop.over_time is not None]
    return summary, over_time if len(over_time) == loops else None


def _summary(run: RecordedRun, ending: RunEnding, loops: Sequence[LoopSummary]) -> RunSummary:
    end = ExitPart(status=int(ending.status), reason=ending.reason)
    return summarise_run(run.network, loops, end, ending.startup_s)


def _blocks(run: RecordedRun) -> Iterator[range]:
    """Yield the loops that are evaluated together: as many as fit into memory, at the end fewer."""
    loops, first = len(run.names), 0
    while first < loops:
        width = min(max((loops - first) // (2 * cores()), _LEAST_LOOPS), run.loops_at_once, loops - first)
        yield range(first, first + width)
        first += width


_stored_run = cache(load_run)
"""The run of a process of the pool, whose objects then live as long as the process."""


@np.errstate(all="ignore")
def _evaluate_loops(
    run: RecordedRun | None, ending: RunEnding, block: Mapping[int, Certificates | None]
) -> list[_LoopResults]:
    """Evaluate consecutive loops, given by their numbers with what is known of them already.

    In another process, ``run`` is None.
    """
    run = run or _stored_run(ending.run_dir)
    loops, numbers = len(run.names), range(min(block), max(block) + 1)
    # The report of one loop uses the claims about the same record.
    records = run.read(numbers) if len(numbers) > 1 else [run.record(numbers[0])]
    results, known = list[_LoopResults](), dict[str, Certificates | None]()
    shared = SharedMachines(records if len(records) > 1 else ())
    for record in records:
        if (own := block[record.number]) is None:
            key = certificates_key(record.scenario)
            if key not in known:  # equal loops share them
                known[key] = expected_certificates(record.scenario, loops)
            own = known[key]
        claims = claims_of(record)
        claims.certificates, claims.most_work = own, search_limit(loops)
        claims.most_steps = max(MOST_STEPS // loops, _LEAST_STEPS)
        phase_ns = run.phases_ns[record.number]
        status, reason = int(ending.status), ending.reason
        summary = summarise_loop(record, status, reason, phase_ns)
        if loops == 1:
            # Written again with the results, so that none of them can cost the summary.
            _write_summary(ending.run_dir, _summary(run, ending, [summary]))
        results.append(_with_results(run, summary, claims, shared))
    return results


def _with_results(
    run: RecordedRun,
    summary: LoopSummary,
    claims: RunClaims,
    shared: SharedMachines,
) -> _LoopResults:
    """Add the results of replay, ideal loop and claims; a failure of one is a line or a warning."""
    record = claims.record
    results: dict[str, Any] = {"ideal_loop": ideal_loop_part(record, summary)}
    try:
        results["linearisation"] = linearisation(record.scenario)
    except Exception as error:  # a failed analysis must not cost the run its summary
        print(f"noack: warning: the plant was not linearised: {error!r}", file=sys.stderr)
    try:
        results |= _claim_results(claims, summary)
    except Exception as error:  # a failed analysis must not cost the run its summary
        print(f"noack: warning: the claims were not evaluated: {error!r}", file=sys.stderr)
    if record.kind == "live":
        replayed = _replay(record, shared)
        results |= {"replay": replayed, "exit": _exit_after_replay(summary.exit, replayed)}
    over_time = None
    with suppress(Exception):  # the recording reports it
        if len(run.names) > 1:
            over_time = loop_over_time(record, run.phases_ns[record.number])
    return _LoopResults(summary.model_copy(update=results), over_time)


def _claim_results(claims: RunClaims, summary: LoopSummary) -> dict[str, Any]:
    longest = summary.longest_loss_burst
    if summary.unintended_losses:
        longest = max(longest, int(claims.largest_observed["dropouts"] or 0))
    return {
        "conditions": ConditionsPart(**claims.largest_observed),
        "allowed": _allowed(claims.allowed),
        "certified_for": _allowed(claims.certified_for),
        "claims": claims.evaluate(),
        "conformance": claims.conformance(),
        "judged_until_s": claims.judged_until_s,
        "longest_loss_burst": longest,
    }


def _allowed(conditions: NetworkConditions | None) -> AllowedConditionsPart | None:
    if conditions is None:
        return None
    return AllowedConditionsPart(
        **{name: getattr(conditions, name) for name in AllowedConditionsPart.model_fields}
    )


def _replay(record: RunRecord, shared: SharedMachines | None = None) -> ReplayPart:
    try:
        return replay(record, shared).verdict()
    except Exception as error:  # the run itself did not fail
        return ReplayPart(bit_exact=None, error=repr(error))


def _exit_after_replay(end: ExitPart, replayed: ReplayPart) -> ExitPart:
    """How a run ended, given its replay: a run that cannot be replayed failed."""
    if end.status != ExitStatus.OK or replayed.bit_exact is not None:
        return end
    why = replayed.error or "the record has no inputs"
    return ExitPart(status=int(ExitStatus.FAILED), reason=f"the run cannot be replayed: {why}")


def reopen(run_dir: Path, *, view: bool = True) -> Outcome:
    """Return the outcome of an earlier run; complete its record and summary if necessary.

    Raises:
        CallerError: it is not a run directory, or the run is still under way.
    """
    require_run_directory(run_dir)
    summary = read_summary(read_object(run_dir / SUMMARY_FILE))
    # A process that was frozen may have spooled rows after the end.
    if summary is not None and not (run_dir / SPOOL).is_dir():
        status = ExitStatus(summary.exit.status)
        return Outcome(run_dir, status, summary.exit.reason, summary)
    ending = _ending(run_dir, read_object(run_dir / ENDING_FILE))
    refuse_links(run_dir)
    unknown = RunEnding(run_dir, 0, ExitStatus.FAILED, "the launcher ended early")
    return finalize(ending or unknown, view=view, again=True)


def _ending(run_dir: Path, content: Mapping[str, Any]) -> RunEnding | None:
    """Return how a run ended by its launcher's file; None if it is not there."""
    with suppress(LookupError, TypeError, ValueError):
        status, reason = ExitStatus(content["exit"]["status"]), str(content["exit"]["reason"])
        return RunEnding(run_dir, 0, status, reason, content["startup_s"])
    return None


@np.errstate(all="ignore")
def run_report(run_dir: Path, loop: str | None = None, *, again: bool = False) -> Path:
    """Return the path of an earlier run's report, or of the report of one of its loops.

    It is written if it is missing, or ``again``.

    Raises:
        CallerError: it is not a run directory, the run is still under way, or there is no such
            loop.
        MachineError: the report cannot be written.
    """
    summary, run = _open(run_dir, loop)
    path = run_dir / file_of_loop(REPORT_FILE, loop)
    if path.is_file() and not again:
        return path
    return _write_report(run, summary, run_dir, loop)


def write_recording(run_dir: Path, loop: str | None = None) -> None:
    """Write the recording of an earlier run, or of one of its loops.

    Raises:
        CallerError, MachineError: as :func:`run_report`.
    """
    require_viewer()
    summary, run = _open(run_dir, loop, view=False)
    _write_recording(run, summary, run_dir, loop)


def _open(run_dir: Path, loop: str | None, *, view: bool = True) -> tuple[RunSummary, RecordedRun]:
    """Return summary and record of an earlier run, which has this loop."""
    summary, run = reopen(run_dir, view=view).summary, load_run(run_dir)
    if run.names != [loop.name for loop in summary.loops]:
        raise CallerError(f"{run_dir}: {SUMMARY_FILE} has other loops than {SCENARIO_FILE}; one was changed")
    if loop is not None:
        run.number_of(loop)  # refuses an unknown name
    return summary, run


def _write_recording(
    run: RecordedRun,
    summary: RunSummary,
    run_dir: Path,
    loop: str | None,
    over_time: Sequence[LoopOverTime] | None = None,
) -> None:
    from cosim.output.viewer.run_recording import write_view  # imports rerun

    write_view(run, summary, run_dir, loop, over_time)


def _write_report(
    run: RecordedRun,
    summary: RunSummary,
    run_dir: Path,
    loop: str | None,
    over_time: Sequence[LoopOverTime] | None = None,
) -> Path:
    from cosim.output.report_page import write_report  # imports matplotlib

    return write_report(run, summary, run_dir, loop, over_time)
