"""Commands about earlier runs: results, figures and pages, replay, export, comparison."""

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from cosim.cli import options as opt
from cosim.cli.options import RUNS, examples
from cosim.cli.printing import print_json, print_lines, show, status, write_tables
from cosim.output.figures.figure_format import requested_files
from cosim.record.run_directory import (
    DEFAULT_RUNS,
    RECORDING_FILE,
    chosen_run,
    file_of_loop,
    is_run_directory,
)
from netem.core.command_line import print_to_stderr
from netem.core.errors import CallerError, ExitStatus, NoackError

app = typer.Typer()


class Plants(StrEnum):
    """What a loop document is of."""

    OWN = "own"
    BOX = "box"


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack view", "the last run, in a window if there is a display"),
        ("noack view runs/latest --web", "in a browser on this machine"),
        ("noack view --loop pendulum-07", "one loop of a run of several, in detail"),
    ),
)
def view(
    recording: Annotated[
        Path | None,
        Argument(
            help="Run directory or .rrd file; the last run by default.", autocompletion=opt.complete_runs
        ),
    ] = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    loop: opt.LoopOption = None,
    web: Annotated[bool, Option("--web", help="Show it in a browser on this machine.")] = False,
    json: opt.JsonOption = False,
) -> int:
    """Show a run in the rerun viewer.

    A missing recording, as that of one loop alone, is written first.
    """
    from cosim.output.viewer.rerun_program import require_recording, require_viewer

    path = chosen_run(recording, runs)
    path = path / file_of_loop(RECORDING_FILE, loop) if path.is_dir() else path
    is_missing = is_run_directory(path.parent) and not path.is_file()
    if is_missing or not json:
        require_viewer()  # before what imports rerun
    if is_missing:
        from cosim.live.finalize import write_recording

        with status("writing the recording"):
            write_recording(path.parent, loop)
    require_recording(path)
    if json:
        print_json({"recording": str(path), "exists": True})
        return ExitStatus.OK
    from cosim.output.viewer.recording_viewer import view_recording

    view_recording(path, native=False if web else None)
    return ExitStatus.OK


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack summary", "the last run"),
        ("noack summary --verbose", "with timing, assumptions and each claim"),
        ("noack summary --tables tables", "its tables as CSV"),
        ("noack summary runs/latest --json", "all numbers, as JSON"),
        ("noack summary runs/latest --add controller.spool", "first add rows that another host kept"),
    ),
)
def summary(
    run_dir: opt.RunArgument = None,
    add: Annotated[
        list[Path] | None,
        Option(
            metavar="FILE",
            help="First add the rows that a process on another host kept because it could not send "
            "them; repeatable.",
        ),
    ] = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    loop: opt.LoopOption = None,
    verbose: opt.VerboseOption = False,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Show a run's summary; finalise an interrupted run first.

    Exit status 0: the summary was shown, also that of a failed run; 2: a table of the run's record
    is missing or cannot be opened.
    """
    from cosim.analysis.summary.run_summary import outcome_of_loop
    from cosim.cli.execute_run import reopen_run
    from cosim.live.finalize import reopen
    from cosim.output.run_document import run_document
    from cosim.output.run_tables import summary_tables
    from cosim.record.added_rows import add_rows
    from cosim.record.run_record import load_run

    path = chosen_run(run_dir, runs)
    outcome = reopen_run(path)  # refuses a run that is under way
    for file in add or ():
        merged, role = add_rows(path, file, reopen)
        outcome = replace(merged, run_dir=path)
        print_to_stderr(f"noack: {file}: added what the {role} kept")
    outcome = outcome_of_loop(outcome, loop)
    show(run_document(outcome, verbose=verbose), json=json)
    write_tables(summary_tables(outcome.summary), tables, json=json)
    try:
        load_run(path)
    except NoackError as error:
        print_to_stderr(f"noack: {error}")
        return error.exit_status
    return ExitStatus.OK


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack replay", "the last run; exit status 1 if a bit differs"),
        ("noack replay runs/latest --json", "as JSON"),
    ),
)
def replay(
    run_dir: opt.RunArgument = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    loop: opt.LoopOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Replay a run's recorded inputs; compare the outputs bit for bit.

    Takes about a second.
    """
    from cosim.analysis.replay.run_replay import replay_run
    from cosim.output.replay_report import replay_document
    from cosim.record.run_directory import changed_since
    from cosim.record.run_record import load_run

    path = chosen_run(run_dir, runs)
    with status("replaying"):
        result = replay_run(load_run(path), loop)
    show(replay_document(result, changed_since(path)), json=json)
    return ExitStatus.OK if result.bit_exact else ExitStatus.FAILED


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack conform", "the last run; exit status 1 if it is another loop's"),
        ("noack conform runs/latest --plants box", "with the document of all plants of its uncertainty"),
    ),
)
def conform(
    run_dir: opt.RunArgument = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    loop: opt.LoopOption = None,
    plants: Annotated[
        Plants | None,
        Option(
            help="Which document: that of the plant itself (own), or that of all plants within its "
            "uncertainty (box); by default the one that noack certify --document writes."
        ),
    ] = None,
    json: opt.JsonOption = False,
) -> int:
    """Compare a run with the loop document that its bounds are proven of.

    The loop document says what the loop may do. If the run does nothing else, the proved bounds of the
    document hold for the run. `noack check NAME --document` prints the document. Exit status 1: the run does
    something that the document does not allow.
    """
    from cosim.analysis.conformance.run_conformance import conformance_of
    from cosim.output.conformance_report import conformance_document
    from cosim.record.run_record import load_run

    path = chosen_run(run_dir, runs)
    with status("comparing"):
        record = load_run(path).loop(loop)
        found = conformance_of(record, plants)
    show(conformance_document(found, record.scenario.name), json=json)
    return ExitStatus.OK if found.conforms else ExitStatus.FAILED


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack compare runs/A runs/B", "key numbers, and a page with the curves overlaid"),
        ("noack compare runs/A runs/B runs/C --out overlay.png", "the overlay as a picture"),
        ("noack compare runs/A:left runs/A:right", "two loops of a run"),
        ("noack compare runs/A runs/B --json", "as JSON"),
    ),
)
def compare(
    directories: Annotated[
        list[Path],
        Argument(
            metavar="RUN...",
            autocompletion=opt.complete_runs,
            help="Two to seven run directories, live or simulated; RUN:NAME is a loop.",
        ),
    ],
    out: Annotated[
        Path | None,
        Option(
            callback=opt.usable_path,
            help="File of the overlay: a page (.html), or a figure (.svg, .png, .pdf); by default "
            "comparison.html beside the first run.",
        ),
    ] = None,
    width: opt.WidthOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Compare runs: key numbers, settings that differ, curves overlaid.

    Takes about a second.
    """
    from cosim.studies.run_comparison import compare_runs

    with status("comparing"):
        comparison = compare_runs(directories)
        file = comparison.default_file if out is None else out
        comparison.save(file, width)
    show(comparison.document, json=json, overlay=str(file))
    if not json:
        print(f"overlay: {file}")


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack report", "the report of the last run"),
        ("noack report --format pdf", "with its figures for a paper"),
        ("noack report --format svg --figure errors", "with one of its figures"),
        ("noack report runs/latest --json", "print the path as JSON"),
    ),
)
def report(
    run_dir: opt.RunArgument = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    loop: opt.LoopOption = None,
    again: Annotated[bool, Option("--again", help="Write the report again, even if there is one.")] = False,
    figure_format: opt.FigureFormatOption = None,
    width: opt.WidthOption = None,
    figure: Annotated[
        str | None,
        Option(
            metavar="NAME",
            help="Write only this figure, e.g. states, errors, state-norm, input or inter-event.",
        ),
    ] = None,
    json: opt.JsonOption = False,
) -> None:
    """Print the path of a run's report (one HTML page with all figures); write it if missing.

    Takes some seconds where it is not there yet.
    """
    from cosim.api.runs import open_run
    from cosim.live.finalize import run_report

    files = requested_files(figure_format, width)  # refuses a wrong width before anything is drawn
    if figure is not None and files is None:
        raise CallerError(f"--figure {figure}: give the format of its file, too, e.g. --format svg")
    chosen = chosen_run(run_dir, runs)
    with status("writing the report"):
        path, drawn = run_report(chosen, loop, again=again), []
    if files is not None:
        whole_run = open_run(chosen)
        loop_run = whole_run if loop is None else whole_run.loops[loop]
        drawn = loop_run.save_figures(files.kind, files.width_in, figure)
    written = {"figures": [str(figure) for figure in drawn]} if drawn else {}
    print_lines(json, {"report": str(path)} | written, path, *drawn)


def _complete_formats(incomplete: str) -> list[str]:
    from cosim.output.export.export_formats import formats

    return [name for name in formats() if name.startswith(incomplete)]


@app.command(
    rich_help_panel=RUNS,
    epilog=examples(
        ("noack export --format mat", "the last run for MATLAB and Octave"),
        ("noack export runs/latest --format csv --json", "a folder of CSV files"),
    ),
)
def export(
    file_format: Annotated[
        str,
        Option(
            "--format",
            metavar="FORMAT",
            autocompletion=_complete_formats,
            help="Format of the file, or of the folder's files: csv, mat, or an extension's.",
        ),
    ],
    run_dir: opt.RunArgument = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    loop: opt.LoopOption = None,
    out: Annotated[
        Path | None,
        Option(help="File, or folder of CSV; RUN.mat and so on by default."),
    ] = None,
    certificates: Annotated[
        bool,
        Option(help="Certificates of each loop in a file of MATLAB; seconds for each loop."),
    ] = True,
    json: opt.JsonOption = False,
) -> None:
    """Export a run for other programs: its tables, its summary and its certificates."""
    from cosim.cli.execute_run import reopen_run
    from cosim.output.export.export_formats import export_run, find_format

    suffix = find_format(file_format).SUFFIX
    reopen_run(chosen := chosen_run(run_dir, runs))
    path = out or Path(f"{loop or chosen.resolve().name}{suffix}")
    with status("exporting"):
        written = export_run(chosen, path, file_format, loop=loop, certificates=certificates)
    print_lines(json, {"files": [str(path) for path in written]}, *written)
