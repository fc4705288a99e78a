"""What all commands share that make runs: warnings, the run itself, its verdict; campaigns.

All processes of a run wait for the slowest one: what the start does not need is imported later.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli import command as cli
from noack.core.errors import CallerError

if TYPE_CHECKING:
    from rich.console import Console

    from cosim.live.fork_server import ForkServer
    from cosim.live.remote_access import Listening
    from cosim.live.run_watcher import Watcher
    from cosim.output.figure_format import FigureFiles
    from cosim.record.run_directory import RunEnding
    from cosim.studies.campaign.campaign_file import Campaign
    from cosim.studies.campaign.campaign_report import FinishedCampaign
    from noack.config.scenario import Scenario

_PER_CORE = 4
"""Maximum worker processes per core; more gain nothing, and use memory."""
Workers = Annotated[
    int | None, typer.Option(help="Worker processes; one per core by default.", min=1)
]


@dataclass(frozen=True)
class RunOutput:
    """What a command prints and writes at the end of a run."""

    report: bool
    """Write ``report.html``."""
    verbose: bool
    """Print all tables."""
    json: bool
    """Print the summary as JSON instead."""


def run_processes(
    load: Callable[[], "Scenario"],
    runs: Path,
    output: RunOutput,
    *,
    spawn: Sequence[str] | None = None,
    session: str | None = None,
    live: bool = False,
    server: "ForkServer | None" = None,
    listening: "Listening | None" = None,
    metrics: str | None = None,
) -> int:
    """Run a scenario live; print its verdict and return the exit status.

    Args:
        load: loads the scenario.
        runs: folder of the run directories.
        output: what is printed and written at the end.
        spawn: roles of the processes to start, all by default; the others join by ``session``.
        session: name that the processes of the run share.
        live: show the run in the viewer.
        server: starts the processes, and ends with the run; by default a new one.
        listening: how processes on other hosts join.
        metrics: address at which the run's metrics are served.
    """
    from cosim.live.fork_server import fork_server

    with fork_server(server) as server:
        from cosim.live.launcher import launch
        from cosim.live.run_watcher import RunLog, Watcher, joint_watcher, later_watcher
        from noack.config.link_load import require_capacity
        from noack.protocol.topology import ROLES

        scenario, ending = load(), None
        require_capacity(scenario)
        warn_of_other_runs()
        # Those of the theory come at the start: nothing waits for the launcher then.
        warnings = Watcher(started=lambda run_dir: warn_of_violations(scenario))
        try:
            with ExitStack() as stack:
                line = later_watcher(lambda: stack.enter_context(_progress(scenario, session)))
                watchers = [warnings, line, RunLog().watcher()]
                if metrics is not None:
                    watchers.append(stack.enter_context(_served_metrics(scenario, metrics)))
                ending = launch(
                    scenario, runs, spawn=spawn or ROLES, session=session, live=live,
                    watcher=joint_watcher(watchers), server=server, listening=listening,
                )  # fmt: skip
        except OSError:  # a closed terminal must not end the run
            if ending is None:
                raise
    return finalize_run(ending, output)


def _progress(scenario: "Scenario", session: str | None) -> "AbstractContextManager[Watcher]":
    """Give what shows the progress of a run; importing rich takes 0.05 s."""
    from cosim.live.progress import error_console, progress_line

    return progress_line(error_console(), scenario, session)


@contextmanager
def _served_metrics(scenario: "Scenario", where: str) -> "Iterator[Watcher]":
    """Serve the metrics of a run within the context; yield what updates them."""
    from noack.runtime.address import text_of
    from noack.runtime.command_line import print_to_stderr
    from noack.runtime.metrics_server import metrics_server, require_package

    require_package()
    from cosim.live.run_metrics import RunMetrics

    found = RunMetrics(scenario)
    with metrics_server(where, found.collect) as address:
        print_to_stderr(f"noack: metrics: http://{text_of(address)}/metrics")
        yield found.watcher()


def warn_of_violations(scenario: "Scenario") -> None:
    """Print the assumptions of Theorem 2 that the scenario violates, on standard error.

    Loops that share a network: also what may go wrong at their bottleneck.
    """
    from noack.config.link_load import link_loads, load_warnings
    from noack.config.resolution import resolve
    from noack.config.scenario import loop_names, loop_scenario, loop_sections
    from noack.theory.certificates.assumptions import AssumptionStatus, assumptions

    shares = len(loop_names(scenario)) > 1
    for line in load_warnings(link_loads(scenario), scenario) if shares else ():
        print(f"noack: warning: {line}", file=sys.stderr)
    for section in loop_sections(scenario):
        whose = f"{section.name}: " if shares else ""
        for assumption in assumptions(resolve(loop_scenario(scenario, section))):
            if assumption.verdict == AssumptionStatus.VIOLATED and assumption.source == "Theorem 2":
                print(
                    f"noack: warning: {whose}violated: {assumption.what}: {assumption.why}",
                    file=sys.stderr,
                )


def warn_of_other_runs() -> None:
    """Print on standard error which runs are active: each may make the others late."""
    from noack.core.errors import PeerError
    from noack.runtime.run_registry import active_runs

    try:
        others = active_runs()
    except PeerError:  # a damaged file of another run must not prevent this one
        return
    for run in others:
        print(
            f"noack: warning: {run.run_dir} is active, too: runs at the same time share the cores "
            "and may miss deadlines",
            file=sys.stderr,
        )


def finalize_run(ending: "RunEnding", output: RunOutput) -> int:
    """Finish a run's record, print its verdict, and return its exit status."""
    from cosim.live.finalize import finalize
    from cosim.live.run_watcher import log_end
    from cosim.output.run_verdict import print_outcome

    try:
        # This takes minutes for a run of an hour.
        with cli.status("replaying the run and checking its claims"):
            outcome = finalize(ending, report=output.report)
    except KeyboardInterrupt as error:
        error.add_note(f"`noack summary {ending.run_dir}` completes its record")
        raise
    log_end(outcome.status, outcome.reason, outcome.run_dir)
    document = outcome.summary.to_json
    cli.show(output.json, document, print_outcome, outcome, verbose=output.verbose)
    return outcome.status


def worker_pool(workers: int | None, scheduler: str | None = None) -> Callable[[Any], Any]:
    """Return a function that starts the workers; its argument is a function that prints a line."""
    from cosim.studies.campaign.campaign_workers import cluster, local

    if scheduler is not None:
        if workers is not None:
            raise CallerError("--workers: with --scheduler the cluster's workers are used")
        return lambda say: cluster(scheduler, say)
    number = workers or cli.cores()
    if number > (most := _PER_CORE * cli.cores()):
        raise CallerError(f"--workers {number}: on this machine at most {most}")
    return lambda say: local(number)


def execute_campaign(
    console: "Console", plan: "Campaign", path: Path, start: Callable[[Any], Any], *,
    folder: Path, draws: int | None = None, figure_files: "FigureFiles | None" = None,
) -> "FinishedCampaign":  # fmt: skip
    """Run or continue a campaign; write its page.

    Args:
        console: shows the progress.
        plan: the campaign.
        path: its file, in whose folder its scenario may be.
        start: starts the workers, see :func:`worker_pool`.
        folder: of the campaign.
        draws: number of draws; the campaign's by default.
        figure_files: write each figure as a file, too.
    """
    from cosim.live.progress import runs_bar
    from cosim.studies.campaign.campaign_report import finish_campaign

    def say(line: str) -> None:
        console.print(f"noack: {line}", highlight=False, markup=False, soft_wrap=True)

    return finish_campaign(
        plan, path, folder, lambda: start(say), draws=draws, figure_files=figure_files,
        show=console.status, bar=runs_bar(console),
    )  # fmt: skip
