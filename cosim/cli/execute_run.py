"""What all commands share that make runs: warnings, the run itself, its verdict.

All processes of a run wait for the slowest one: what the start does not need is imported later.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.cli.printing import show, status, status_of
from cosim.live import launcher
from cosim.live.coordination.remote_access import ListenSettings
from cosim.live.monitoring.run_observers import RunLog, RunObserver, log_end
from cosim.live.monitoring.run_terminal import RunTerminal
from cosim.record.run_directory import RunEnding, how_to_complete
from netem.core.errors import PeerError
from noack.protocol.roles import ROLES
from noack.runtime.active_runs import active_runs
from noack.scenario.resolution import ResolvedRun, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.uneven_periods import uneven_periods

if TYPE_CHECKING:
    from cosim.analysis.summary.run_summary import Outcome
    from cosim.output.requirement import Requirement


def run_processes(
    loaded: Scenario,
    runs: Path,
    *,
    live: bool = False,
    report: bool = True,
    verbose: bool = False,
    json: bool = False,
    required: "Sequence[Requirement]" = (),
    spawn: Sequence[str] | None = None,
    session: str | None = None,
    listening: ListenSettings | None = None,
) -> int:
    """Run a scenario live, where this is possible; print its verdict and return the exit status.

    Args:
        loaded: the scenario.
        runs: folder of the run directories.
        live: show the run in the rerun viewer.
        report: write the report.
        verbose: print all tables.
        json: print the summary as JSON.
        required: what the run must meet; otherwise the status is 1.
        spawn: roles of the processes to start, all by default; the others join by ``session``.
        session: name that the processes of the run share.
        listening: how processes on other hosts join.
    """
    ending = None
    if live:
        from cosim.output.viewer.rerun_program import require_viewer  # imports http.client and TLS

        require_viewer()
    warn_of_other_runs()
    try:
        with RunTerminal(loaded) as terminal:
            ending = launcher.launch(
                loaded,
                runs,
                spawn=spawn or ROLES,
                session=session,
                live=live,
                fork=True,
                observers=[_TheoryWarnings(loaded), terminal, RunLog()],
                listening=listening,
            )
    except OSError:  # a closed terminal must not end the run
        if ending is None:
            raise
    return finalize_run(ending, report=report, verbose=verbose, json=json, required=required)


class _TheoryWarnings(RunObserver):
    """Warns of what the theory does not cover when the run has started: nothing waits for it then."""

    def __init__(self, loaded: Scenario) -> None:
        self._loaded = loaded

    def started(self, run_dir: Path) -> None:
        """Print the warnings."""
        warn_of_violations(self._loaded)


def warn_of_violations(loaded: Scenario, *, is_sampled: bool = True) -> None:
    """Print on standard error which assumptions gain and threshold violate.

    Of a sampled run also the periods that do not divide each other.
    """
    from noack.theory.certificates.assumptions import violated_by_gain_or_threshold

    run = ResolvedRun(loaded)
    for entry in run.entries:
        prefix = f"{entry.name}: " if len(run.names) > 1 else ""
        resolved = resolve(entry.scenario)
        uneven = uneven_periods(resolved) if is_sampled else ()
        for line in (*violated_by_gain_or_threshold(resolved), *uneven):
            print(f"noack: warning: {prefix}{line}", file=sys.stderr)


def warn_of_left_out(loaded: Scenario) -> None:
    """Print on standard error which of the network's impairments a continuous simulation leaves out."""
    from cosim.simulation.exact_simulation import left_out

    if kinds := left_out(loaded.network.link):
        print(
            f"noack: warning: network.impairments: {kinds}: left out, in continuous time the network "
            "has no delay",
            file=sys.stderr,
        )


def warn_of_other_runs() -> None:
    """Print on standard error which runs are active: each may make the others late."""
    try:
        other_runs = active_runs()
    except PeerError:  # a damaged file of another run must not prevent this one
        return
    for run in other_runs:
        print(
            f"noack: warning: {run.run_dir} is active, too: runs at the same time share the cores "
            "and may miss deadlines",
            file=sys.stderr,
        )


def simulate_continuously(loaded: Scenario, *, json: bool, required: "Sequence[Requirement]" = ()) -> int:
    """Simulate a scenario in continuous time, print the result, and return the exit status."""
    from cosim.output.continuous_report import continuous_document
    from cosim.output.requirements import refuse_for_exact_runs, unmet_by_exact_run
    from cosim.simulation import continuous

    refuse_for_exact_runs(required)
    resolved = resolve(loaded)
    with status("simulating"):
        run = continuous.run_continuous(resolved)
    summary = continuous.summary(run, resolved)
    show(continuous_document(run, resolved), json=json)
    return status_of(unmet_by_exact_run(summary, required), summary.exit_status)


_COMPLETING = "replaying the run, checking its claims"
_WITH_REPORT = f"{_COMPLETING}, writing its report"


def reopen_run(run_dir: Path) -> "Outcome":
    """Return the outcome of an earlier run; show that its record is completed, if that is necessary."""
    from cosim.live.finalize import reopen

    with status(f"{run_dir}: {_WITH_REPORT}"):
        return reopen(run_dir)


def finalize_run(
    ending: RunEnding,
    *,
    report: bool,
    verbose: bool,
    json: bool,
    required: "Sequence[Requirement]" = (),
) -> int:
    """Finish a run's record, print its verdict, and return its exit status."""
    from cosim.live.finalize import finalize
    from cosim.output.requirements import unmet_by_run
    from cosim.output.run_document import run_document

    try:
        # This takes minutes for a run of an hour.
        with status(_WITH_REPORT if report else _COMPLETING):
            outcome = finalize(ending, report=report)
    except KeyboardInterrupt as error:
        error.add_note(how_to_complete(ending.run_dir))
        raise
    log_end(outcome.status, outcome.reason, outcome.run_dir)
    show(run_document(outcome, verbose=verbose), json=json)
    return status_of(unmet_by_run(outcome.summary, required), outcome.status)
