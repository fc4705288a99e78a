"""The end of a run of several loops: each loop finalised, and the summary of the whole."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

from cosim.analysis.loops_summary import LoopsSummary, summarise_loops
from cosim.analysis.replay import replay
from cosim.analysis.run_summary import Outcome
from cosim.analysis.summary_model import ExitPart, ReplayPart
from cosim.live.process_pool import interrupts_held, processes
from cosim.live.progress import work_bar
from cosim.record.loops_run import loop_directories
from cosim.record.loops_spool import distribute_rows
from cosim.record.run_ending import RunEnding
from cosim.record.run_record import RunRecord, load_record
from cosim.record.spool_conversion import convert_spool, remove_spool
from noack.config.loops import loops_of
from noack.config.scenario import Scenario
from noack.core.errors import ExitStatus
from noack.core.python_process import cores

_MANY_STEPS = 50_000
"""Loops with fewer steps of the plant, all together, are finalised in less time than processes
start."""


def finalize_loops(
    ending: RunEnding, finalize_loop: Callable[[RunEnding], Outcome], *, unfinished: bool
) -> tuple[RunRecord, LoopsSummary]:
    """Finalise each loop of a run; return the record of the network, and the summary of the run.

    Args:
        ending: how the run ended.
        finalize_loop: completes record and summary of a loop, from how its run ended; it can be
            pickled.
        unfinished: whether the run has a spool, which is removed when all loops are finalised.

    Raises:
        MachineError: a record or a summary cannot be written; the spool is kept.
    """
    run_dir = ending.run_dir
    if unfinished:
        with work_bar("rows of the loops") as show:
            distribute_rows(run_dir, show)
        convert_spool(run_dir)
    network = load_record(run_dir, network=True)
    endings = [
        RunEnding(one, 0, ending.status, ending.reason, ending.startup_s)
        for one in loop_directories(run_dir, network.scenario)
    ]
    what = f"record and claims of {len(endings)} loops"
    with _each(finalize_loop, endings, network.scenario) as each, work_bar(what) as show:
        replayed = _replay(network) if network.kind == "live" else None
        outcomes = []
        for outcome in each:
            outcomes.append(outcome)
            show(len(outcomes) / len(endings))
    if unfinished:
        remove_spool(run_dir)
    end = ExitPart(status=int(ending.status), reason=ending.reason)
    summary = summarise_loops(network, outcomes, end, ending.startup_s)
    if replayed is None:
        return network, summary
    end = exit_after_replay(summary.exit, replayed)
    return network, summary.model_copy(update={"replay": replayed, "exit": end})


def exit_after_replay(end: ExitPart, replayed: ReplayPart) -> ExitPart:
    """How a run ended, given its replay: a run that cannot be replayed failed."""
    if end.status != ExitStatus.OK or replayed.bit_exact is not None:
        return end
    why = replayed.error or "the record has no inputs"
    return ExitPart(status=int(ExitStatus.FAILED), reason=f"the run cannot be replayed: {why}")


@contextmanager
def _each(
    finalize_loop: Callable[[RunEnding], Outcome], endings: Sequence[RunEnding], scenario: Scenario
) -> Iterator[Iterable[Outcome]]:
    """Finalise the loops, those of a long run in a process for each core; yield the outcomes."""
    timing = loops_of(scenario)[0].timing
    workers = min(cores(), len(endings))
    if workers < 2 or len(endings) * timing.horizon_ns // timing.plant_period_ns < _MANY_STEPS:
        yield map(finalize_loop, endings)
        return
    with processes(workers) as pool:
        with interrupts_held():
            outcomes = [pool.submit(finalize_loop, one) for one in endings]
        yield (one.result() for one in outcomes)


def _replay(network: RunRecord) -> ReplayPart:
    try:
        return ReplayPart(**replay(network).verdict())
    except Exception as error:  # the run itself did not fail
        return ReplayPart(bit_exact=None, error=repr(error))
