"""The end of a run of several loops: each loop finalised, and the summary of the whole."""

from collections.abc import Callable

from cosim.analysis.replay import replay
from cosim.analysis.run_summary import Outcome
from cosim.analysis.shared_summary import SharedSummary, summarise_shared
from cosim.analysis.summary_model import ExitPart, ReplayPart
from cosim.record.run_ending import RunEnding
from cosim.record.run_record import RunRecord
from cosim.record.shared_run import loop_directories


def finalize_loops(
    network: RunRecord, ending: RunEnding, finalize_loop: Callable[[RunEnding], Outcome]
) -> SharedSummary:
    """Finalise each loop of a run; return the summary of the run.

    Args:
        network: the record of the network that the loops share.
        ending: how the run ended.
        finalize_loop: writes the summary of a loop, from how its run ended.
    """
    directories = loop_directories(ending.run_dir, network.scenario)
    outcomes = [
        finalize_loop(RunEnding(one, 0, ending.status, ending.reason, ending.startup_s))
        for one in directories
    ]
    end = ExitPart(status=int(ending.status), reason=ending.reason)
    summary = summarise_shared(network, outcomes, end, ending.startup_s)
    if network.kind != "live":
        return summary
    try:
        replayed = ReplayPart(**replay(network).verdict())
    except Exception as error:  # the run itself did not fail
        replayed = ReplayPart(bit_exact=None, error=repr(error))
    return summary.model_copy(update={"replay": replayed})
