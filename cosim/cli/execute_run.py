"""What all commands share that make runs: warnings, the run itself, its verdict; campaigns.

All processes of a run wait for the slowest one: what the start does not need is imported later.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.lazy_modules import lazy_modules
from cosim.record.run_directory import DEFAULT_RUNS
from noack.core.errors import CallerError, PeerError
from noack.core.system_processes import cores
from noack.runtime.command_line import LogFormat, log_format, print_to_stderr

with lazy_modules():
    from cosim.live import finalize, launcher
    from cosim.live.coordination import remote_access
    from cosim.live.monitoring import progress, run_watcher
    from cosim.live.processes import fork_server
    from cosim.output import terminal_output
    from cosim.output.viewer import rerun_program
    from cosim.record import run_directory
    from cosim.simulation import exact_simulation
    from cosim.studies.campaign import campaign_file, campaign_report, campaign_workers
    from noack.core import core_library
    from noack.protocol import roles
    from noack.runtime import active_runs, address
    from noack.runtime.connections import metrics_server
    from noack.scenario import resolution, scenario
    from noack.theory.certificates import assumptions

if TYPE_CHECKING:
    from cosim.analysis.summary.run_summary import Outcome
    from cosim.output.figures.figure_format import FigureFiles

_PER_CORE = 4
"""Maximum worker processes per core; more gain nothing, and use memory."""
Workers = Annotated[int | None, Option(help="Worker processes; one per core by default.", min=1)]


@opt.option_group
class OutputOptions:
    """What a command prints and writes at the end of a run.

    Options:
        report: Write report.html, which takes about 2 s; `noack report` writes it later.
    """

    report: bool = True
    verbose: opt.VerboseOption = False
    json: opt.JsonOption = False


def _log_format(context: typer.Context, chosen: LogFormat) -> LogFormat:
    """Write standard error in this format until the command ends."""
    stack = ExitStack()
    stack.enter_context(log_format(chosen))
    context.find_root().call_on_close(stack.close)
    return chosen


@opt.option_group
class LiveOptions(OutputOptions):
    """How a live run is made.

    Options:
        live: Show the run in the rerun viewer: in a window, or without a display in a browser, at
            the address that is printed.
        metrics: Serve the run's metrics for Prometheus (OpenMetrics) at this address; the loopback
            without a HOST.
        log_format: Format of standard error: text, or JSON Lines for log collectors.
    """

    runs: opt.RunsOption = DEFAULT_RUNS
    live: Annotated[bool, Option("--live")] = False
    metrics: Annotated[str | None, Option(metavar="[HOST]:PORT")] = None
    log_format: Annotated[LogFormat, Option(callback=_log_format, is_eager=True)] = LogFormat.TEXT


def run_processes(
    loaded: "scenario.Scenario",
    options: LiveOptions,
    *,
    spawn: Sequence[str] | None = None,
    session: str | None = None,
    server: "fork_server.ForkServer | None" = None,
    listening: "remote_access.ListenSettings | None" = None,
    watcher: "run_watcher.Watcher | None" = None,
) -> int:
    """Run a scenario live; print its verdict and return the exit status.

    Args:
        loaded: the scenario.
        options: of the command.
        spawn: roles of the processes to start, all by default; the others join by ``session``.
        session: name that the processes of the run share.
        server: starts the processes, and ends with the run; by default a new one.
        listening: how processes on other hosts join.
        watcher: follows the run, too.
    """
    core_library.require_live_runs()
    with fork_server.fork_server(server) as server:
        ending = None
        if options.live:
            rerun_program.require_viewer()
        warn_of_other_runs()
        # Those of the theory come at the start: nothing waits for the launcher then.
        warnings = run_watcher.Watcher(started=lambda run_dir: warn_of_violations(loaded))
        try:
            with ExitStack() as stack:
                line = run_watcher.later_watcher(
                    lambda: stack.enter_context(progress.progress_line(progress.error_console(), loaded))
                )
                watchers = [warnings, line, run_watcher.RunLog().watcher()]
                watchers += [] if watcher is None else [watcher]
                if options.metrics is not None:
                    watchers.append(stack.enter_context(_serve_metrics(loaded, options.metrics)))
                ending = launcher.launch(
                    loaded,
                    options.runs,
                    spawn=spawn or roles.ROLES,
                    session=session,
                    live=options.live,
                    watcher=run_watcher.joint_watcher(watchers),
                    server=server,
                    listening=listening,
                )
        except OSError:  # a closed terminal must not end the run
            if ending is None:
                raise
    return finalize_run(ending, options)


@contextmanager
def _serve_metrics(loaded: "scenario.Scenario", requested_address: str) -> "Iterator[run_watcher.Watcher]":
    """Serve the metrics of a run within the context; yield what updates them."""
    metrics_server.require_package()
    metrics = run_watcher.RunMetrics(loaded)
    with metrics_server.metrics_server(requested_address, metrics.collect) as bound:
        print_to_stderr(f"noack: metrics: http://{address.address_text(bound)}/metrics")
        yield metrics.watcher()


def warn_of_violations(loaded: "scenario.Scenario") -> None:
    """Print the assumptions of Theorem 2 that the scenario violates, on standard error."""
    shares = len(scenario.loop_names(loaded)) > 1
    for section in scenario.loop_sections(loaded):
        prefix = f"{section.name}: " if shares else ""
        resolved = resolution.resolve(scenario.loop_scenario(loaded, section))
        for line in assumptions.violations_of_theorem_2(resolved):
            print(f"noack: warning: {prefix}{line}", file=sys.stderr)


def warn_of_left_out(loaded: "scenario.Scenario") -> None:
    """Print on standard error which of the network's impairments a continuous simulation leaves out."""
    if kinds := exact_simulation.left_out(loaded.network.link):
        print(
            f"noack: warning: network.impairments: {kinds}: left out, in continuous time the network "
            "has no delay",
            file=sys.stderr,
        )


def warn_of_other_runs() -> None:
    """Print on standard error which runs are active: each may make the others late."""
    try:
        other_runs = active_runs.active_runs()
    except PeerError:  # a damaged file of another run must not prevent this one
        return
    for run in other_runs:
        print(
            f"noack: warning: {run.run_dir} is active, too: runs at the same time share the cores "
            "and may miss deadlines",
            file=sys.stderr,
        )


_COMPLETING = "replaying the run, checking its claims, writing its report"


def reopen_run(run_dir: Path) -> "Outcome":
    """Return the outcome of an earlier run; show that its record is completed, if that is necessary."""
    with cli.status(f"{run_dir}: {_COMPLETING}"):
        return finalize.reopen(run_dir)


def finalize_run(ending: "run_directory.RunEnding", options: OutputOptions) -> int:
    """Finish a run's record, print its verdict, and return its exit status."""
    try:
        # This takes minutes for a run of an hour.
        with cli.status(_COMPLETING):
            outcome = finalize.finalize(ending, report=options.report)
    except KeyboardInterrupt as error:
        error.add_note(run_directory.how_to_complete(ending.run_dir))
        raise
    run_watcher.log_end(outcome.status, outcome.reason, outcome.run_dir)
    document, text = outcome.summary.to_json, terminal_output.print_outcome
    cli.show(options.json, document, text, outcome, verbose=options.verbose)
    return outcome.status


StartWorkers = Callable[[Callable[[str], None]], AbstractContextManager["campaign_workers.Runner"]]
"""Starts workers, given a function that prints a line."""


def worker_pool(workers: int | None, scheduler: str | None = None) -> StartWorkers:
    """Return a function that starts the workers."""
    if scheduler is not None:
        if workers is not None:
            raise CallerError("--workers: with --scheduler the cluster's workers are used")
        return lambda print_line: campaign_workers.cluster_runner(scheduler, print_line)
    number = workers or cores()
    if number > (limit := _PER_CORE * cores()):
        raise CallerError(f"--workers {number}: on this machine at most {limit}")
    return lambda print_line: campaign_workers.local_runner(number)


def execute_campaign(
    plan: "campaign_file.Campaign",
    path: Path,
    start: StartWorkers,
    *,
    folder: Path,
    draws: int | None = None,
    figure_files: "FigureFiles | None" = None,
) -> "campaign_report.FinishedCampaign":
    """Run or continue a campaign; write its page.

    Args:
        plan: the campaign.
        path: its file, in whose folder its scenario may be.
        start: starts the workers, see :func:`worker_pool`.
        folder: of the campaign.
        draws: number of draws; the campaign's by default.
        figure_files: write each figure as a file, too.
    """
    console = progress.error_console()

    def print_line(line: str) -> None:
        console.print(f"noack: {line}", highlight=False, markup=False, soft_wrap=True)

    shown = draws or plan.draws
    has_fewer = campaign_report.had_more_draws(folder, shown)
    finished = campaign_report.finish_campaign(
        plan,
        path,
        folder,
        lambda: start(print_line),
        draws=draws,
        figure_files=figure_files,
        show=progress.activity,
        bar=progress.runs_bar(console),
    )
    if has_fewer:
        print_line(
            f"{folder}: page and summary are now those of the first {shown:,} draws; all other runs are "
            "kept, and a larger --draws shows them again"
        )
    return finished
