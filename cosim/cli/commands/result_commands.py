"""``noack summary``, ``view``, ``report``, ``replay``, ``fidelity``, ``export``: an earlier run."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from cosim.cli import command as cli
from cosim.lazy_modules import lazy_modules
from cosim.output.export import FORMATS, export_run, export_suffix
from cosim.record.run_directory import RECORDING_FILE, SCENARIO_FILE, chosen_run, file_of_loop
from noack.core.errors import ExitStatus

with lazy_modules():
    import cosim.analysis.replay.replay_result as replay_result
    import cosim.analysis.replay.run_replay as run_replay
    import cosim.api.runs as run_library
    from cosim.analysis import fidelity as fidelity_analysis
    from cosim.analysis import run_summary
    from cosim.live import finalize
    from cosim.output import figure_files, run_figures, run_tables, run_verdict
    from cosim.output.viewer import live_viewer
    from cosim.record import run_directory, run_record


@cli.command(cli.RUNS, 50)
def summary(
    run: cli.LoopOptions,
    *,
    verbose: cli.VerboseOption = False,
    tables: cli.TablesOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Show a run's summary; finalise an interrupted run first.

    Exit status 0: the summary was shown, also that of a failed run.

    Examples:
        noack summary   the last run
        noack summary --verbose   with timing, assumptions and each claim
        noack summary --tables tables   its tables for a paper, as LaTeX and CSV
        noack summary runs/latest --json   all numbers, as JSON
    """
    outcome = run_summary.outcome_of_loop(finalize.reopen(run.path), run.loop)
    cli.show(json, outcome.summary.to_json, run_verdict.print_outcome, outcome, verbose=verbose)
    cli.write_tables(run_tables.summary_tables(outcome.summary), tables, json=json)


@cli.command(cli.RUNS, 40)
def view(
    recording: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    web: Annotated[bool, Option("--web")] = False,
    json: cli.JsonOption = False,
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
    live_viewer.view_recording(path, native=False if web else None)
    return ExitStatus.OK


@cli.command(cli.RUNS, 90)
def report(
    run: cli.LoopOptions,
    *,
    again: Annotated[bool, Option("--again")] = False,
    figures: cli.FigureOptions,
    json: cli.JsonOption = False,
) -> None:
    """Print the path of a run's report (one HTML page with all figures); write it if missing.

    Options:
        again: Write the report again, even if there is one.

    Examples:
        noack report   the report of the last run
        noack report --format pdf   with its figures for a paper
        noack report runs/latest --json   print the path as JSON
    """
    files = figures.files  # refuses a wrong width before anything is drawn
    path, drawn = finalize.run_report(run.path, run.loop, again=again), []
    if files is not None:
        opened = run_library.open_run(run.path)
        shown = opened if run.loop is None else opened.loops[run.loop]
        drawn = shown.save_figures(files.kind, files.width_in)
    written = {"figures": [str(figure) for figure in drawn]} if drawn else {}
    cli.print_lines(json, {"report": str(path)} | written, path, *drawn)


@cli.command(cli.RUNS, 70)
def replay(run: cli.LoopOptions, *, json: cli.JsonOption = False) -> int:
    """Replay a run's recorded inputs; compare the outputs bit for bit.

    Examples:
        noack replay   the last run; exit status 1 if a bit differs
        noack replay runs/latest --json   as JSON
    """
    path = run.path
    with cli.status("replaying"):
        found = run_replay.replay_run(run_record.load_run(path), run.loop)
    changed = run_directory.changed_since(path)
    document = found.document() | {"changed_since": changed}
    cli.show(json, lambda: document, replay_result.print_replay, found, changed)
    return ExitStatus.OK if found.bit_exact else ExitStatus.FAILED


@cli.command(cli.RUNS, 60)
def fidelity(
    run: cli.LoopOptions,
    *,
    out: cli.OutOption = None,
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Compare a run with the ideal loop in continuous time, effect by effect.

    Options:
        out: Write a figure of the differences over time (.svg, .png, .pdf).

    Examples:
        noack fidelity   effects of sampling, delay and hold on the last run
        noack fidelity --out fidelity.png   with a figure
        noack fidelity runs/latest --json   as JSON
    """
    with cli.status("comparing"):
        found = fidelity_analysis.compute_fidelity(run_record.load_record(run.path, run.loop))
        if out is not None:
            figure_files.save_figure(run_figures.fidelity_figure(found), out, width)
    cli.show(json, found.as_json, run_verdict.print_fidelity, found)
    return ExitStatus.OK if found.explained else ExitStatus.FAILED


def _known_format(name: str) -> str:
    if name not in FORMATS:
        raise typer.BadParameter(f"'{name}' is not one of {', '.join(FORMATS)}")
    return name


@cli.command(cli.RUNS, 96)
def export(
    run: cli.LoopOptions,
    *,
    file_format: Annotated[
        str,
        Option(
            "--format",
            parser=_known_format,
            metavar="|".join(FORMATS),
            autocompletion=lambda: [*FORMATS],
        ),
    ],
    out: cli.OutOption = None,
    certificates: bool = True,
    json: cli.JsonOption = False,
) -> None:
    """Export a run for other programs: its tables, its summary and its certificates.

    Options:
        file_format: Format of the file, or of the folder's files.
        out: File, or folder of CSV; RUN.mat and so on by default.
        certificates: Certificates of each loop in a file of MATLAB; about a second for each loop.

    Examples:
        noack export --format mat   the last run for MATLAB and Octave
        noack export --format mcap --out run.mcap   for Foxglove and PlotJuggler
        noack export runs/latest --format csv --json   a folder of CSV files
    """
    finalize.reopen(chosen := run.path)
    name = run.loop or chosen.resolve().name
    path = out or Path(f"{name}{export_suffix(file_format)}")
    with cli.status("exporting"):
        written = export_run(chosen, path, file_format, loop=run.loop, certificates=certificates)
    cli.print_lines(json, {"files": [str(path) for path in written]}, *written)
