"""Commands about earlier runs: results, figures and pages, replay, export, comparison."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.cli.execute_run import reopen_run
from cosim.lazy_modules import lazy_modules
from cosim.output.export.export_formats import export_run, find_format, formats
from cosim.record.run_directory import DEFAULT_RUNS, RECORDING_FILE, SCENARIO_FILE, chosen_run, file_of_loop
from noack.core.errors import CallerError, ExitStatus, NoackError
from noack.runtime.command_line import print_to_stderr

with lazy_modules():
    import cosim.analysis.replay.replay_result as replay_result
    import cosim.analysis.replay.run_replay as run_replay
    import cosim.api.runs as run_library
    from cosim.analysis.summary import run_summary
    from cosim.live import finalize
    from cosim.output import result_tables, run_tables, terminal_output
    from cosim.output.viewer import recording_viewer, rerun_program
    from cosim.record import collection, run_directory, run_record
    from cosim.studies import run_comparison


@cli.command(cli.RUNS, 50)
def summary(
    run: opt.LoopOptions,
    *,
    verbose: opt.VerboseOption = False,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Show a run's summary; finalise an interrupted run first.

    Exit status 0: the summary was shown, also that of a failed run; 2: a table of the run's record
    is missing or cannot be opened.

    Examples:
        noack summary   the last run
        noack summary --verbose   with timing, assumptions and each claim
        noack summary --tables tables   its tables as CSV
        noack summary runs/latest --json   all numbers, as JSON
    """
    outcome = run_summary.outcome_of_loop(reopen_run(run.path), run.loop)
    cli.show(json, outcome.summary.to_json, terminal_output.print_outcome, outcome, verbose=verbose)
    cli.write_tables(run_tables.summary_tables(outcome.summary), tables, json=json)
    return _record_status(run.path)


def _record_status(run_dir: Path) -> int:
    """Open the tables of a run; if one cannot be opened, print why and return the exit status."""
    try:
        run_record.load_run(run_dir)
    except NoackError as error:
        print_to_stderr(f"noack: {error}")
        return error.exit_status
    return ExitStatus.OK


@cli.command(cli.RUNS, 40)
def view(
    recording: opt.RunArgument = None,
    *,
    runs: opt.RunsOption = DEFAULT_RUNS,
    loop: opt.LoopOption = None,
    web: Annotated[bool, Option("--web")] = False,
    json: opt.JsonOption = False,
) -> int:
    """Show a run in the rerun viewer.

    A missing recording, as that of one loop alone, is written first.

    Options:
        recording: Run directory or .rrd file; the last run by default.
        web: Show it in a browser on this machine.

    Examples:
        noack view   the last run, in a window if there is a display
        noack view runs/latest --web   in a browser on this machine
        noack view --loop pendulum-07   one loop of a run of several, in detail
    """
    path = chosen_run(recording, runs)
    path = path / file_of_loop(RECORDING_FILE, loop) if path.is_dir() else path
    if (path.parent / SCENARIO_FILE).is_file() and not path.is_file():
        with cli.status("writing the recording"):
            finalize.write_recording(path.parent, loop)
    if json:
        cli.print_json({"recording": str(path), "exists": path.is_file()})
        return ExitStatus.OK if path.is_file() else ExitStatus.CALLER
    rerun_program.require_viewer()
    recording_viewer.view_recording(path, native=False if web else None)
    return ExitStatus.OK


@cli.command(cli.RUNS, 90, takes="some seconds where it is not there yet")
def report(
    run: opt.LoopOptions,
    *,
    again: Annotated[bool, Option("--again")] = False,
    figures: opt.FigureOptions,
    figure: Annotated[str | None, Option("--figure", metavar="NAME")] = None,
    json: opt.JsonOption = False,
) -> None:
    """Print the path of a run's report (one HTML page with all figures); write it if missing.

    Options:
        again: Write the report again, even if there is one.
        figure: Write only this figure, e.g. states, errors, state-norm, input or inter-event.

    Examples:
        noack report   the report of the last run
        noack report --format pdf   with its figures for a paper
        noack report --format svg --figure errors   with one of its figures
        noack report runs/latest --json   print the path as JSON
    """
    files = figures.files  # refuses a wrong width before anything is drawn
    if figure is not None and files is None:
        raise CallerError(f"--figure {figure}: give the format of its file, too, e.g. --format svg")
    with cli.status("writing the report"):
        path, drawn = finalize.run_report(run.path, run.loop, again=again), []
    if files is not None:
        whole_run = run_library.open_run(run.path)
        loop_run = whole_run if run.loop is None else whole_run.loops[run.loop]
        drawn = loop_run.save_figures(files.kind, files.width_in, figure)
    written = {"figures": [str(figure) for figure in drawn]} if drawn else {}
    cli.print_lines(json, {"report": str(path)} | written, path, *drawn)


@cli.command(cli.RUNS, 70, takes="about a second")
def replay(run: opt.LoopOptions, *, json: opt.JsonOption = False) -> int:
    """Replay a run's recorded inputs; compare the outputs bit for bit.

    Examples:
        noack replay   the last run; exit status 1 if a bit differs
        noack replay runs/latest --json   as JSON
    """
    path = run.path
    with cli.status("replaying"):
        result = run_replay.replay_run(run_record.load_run(path), run.loop)
    changed = run_directory.changed_since(path)
    document = result.to_json() | {"changed_since": changed}
    cli.show(json, lambda: document, replay_result.print_replay, result, changed)
    return ExitStatus.OK if result.bit_exact else ExitStatus.FAILED


def _known_format(name: str) -> str:
    try:
        find_format(name)
    except CallerError as error:
        raise typer.BadParameter(str(error)) from None
    return name


@cli.command(cli.RUNS, 96)
def export(
    run: opt.LoopOptions,
    *,
    file_format: Annotated[
        str,
        Option(
            "--format",
            parser=_known_format,
            metavar="FORMAT",
            autocompletion=lambda: [*formats()],
        ),
    ],
    out: opt.OutOption = None,
    certificates: bool = True,
    json: opt.JsonOption = False,
) -> None:
    """Export a run for other programs: its tables, its summary and its certificates.

    Options:
        file_format: Format of the file, or of the folder's files: csv, mat, or an extension's.
        out: File, or folder of CSV; RUN.mat and so on by default.
        certificates: Certificates of each loop in a file of MATLAB; about a second for each loop.

    Examples:
        noack export --format mat   the last run for MATLAB and Octave
        noack export --format mcap --out run.mcap   for Foxglove and PlotJuggler
        noack export runs/latest --format csv --json   a folder of CSV files
    """
    reopen_run(chosen := run.path)
    path = out or Path(f"{run.loop or chosen.resolve().name}{find_format(file_format).SUFFIX}")
    with cli.status("exporting"):
        written = export_run(chosen, path, file_format, loop=run.loop, certificates=certificates)
    cli.print_lines(json, {"files": [str(path) for path in written]}, *written)


@cli.command(cli.RUNS, 55)
def collect(
    run_dir: Annotated[Path, Argument()],
    sources: Annotated[list[str], Argument()],
    *,
    json: opt.JsonOption = False,
) -> None:
    """Add what processes on other hosts kept of a run, and finalise it again.

    A process that was invited keeps its rows on its host when the recorder is out of reach at the
    end. It then prints their folder.

    Options:
        run_dir: Run directory.
        sources: Folders named by the processes: FOLDER, or HOST:FOLDER for scp.

    Examples:
        noack collect runs/latest robot:noack/runs/RUN   by scp from the host robot
        noack collect runs/latest copy   from a folder that was copied here
    """
    run_dir = chosen_run(run_dir, DEFAULT_RUNS)
    outcome = reopen_run(run_dir)  # refuses a run that is under way
    for source in sources:
        merged, roles = collection.collect(run_dir, source, finalize.reopen)
        outcome = replace(merged, run_dir=run_dir)
        print_to_stderr(f"noack: {source}: took what {', '.join(roles) or 'no process'} kept")
    cli.show(json, outcome.summary.to_json, terminal_output.print_outcome, outcome)


@cli.command(cli.RUNS, 80, takes="about a second")
def compare(
    directories: Annotated[list[Path], Argument(metavar="RUN...", autocompletion=opt.complete_runs)],
    *,
    out: opt.OutWithDefault = DEFAULT_RUNS / "comparison.html",
    width: opt.WidthOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Compare runs: key numbers, settings that differ, curves overlaid.

    Options:
        directories: Two to seven run directories, live or simulated; RUN:NAME is a loop.
        out: File of the overlay: a page (.html), or a figure (.svg, .png, .pdf).

    Examples:
        noack compare runs/A runs/B   key numbers, and a page with the curves overlaid
        noack compare runs/A runs/B runs/C --out overlay.png   the overlay as a picture
        noack compare runs/A:left runs/A:right   two loops of a run
        noack compare runs/A runs/B --json   as JSON
    """
    with cli.status("comparing"):
        comparison = run_comparison.compare_runs(directories)
        comparison.save(out, width)
    if json:
        cli.print_json(comparison.to_json() | {"overlay": str(out)})
        return
    console = cli.console()
    for run in comparison.runs:
        line = f"{run.label}  {run.title}  {run.directory}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    labels = [run.label for run in comparison.runs]
    tables = {"key numbers (in brackets: difference to A)": comparison.rows}
    if comparison.settings:
        tables["settings that differ"] = comparison.setting_rows
    for title, rows in tables.items():
        table = result_tables.ResultTable("", title, ("", *labels), rows)
        console.print(result_tables.terminal_table(table))
    console.print(f"overlay: {out}", markup=False, highlight=False, soft_wrap=True)
