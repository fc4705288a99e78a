"""``noack summary``, ``view``, ``report``, ``replay``, ``fidelity``, ``export``: an earlier run."""

from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from cosim.cli import command as cli
from cosim.output.export import FORMATS
from cosim.record.run_directory import RECORDING_FILE, SCENARIO_FILE, chosen_run, file_of_loop
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 50, [
    ("noack summary", "the last run"),
    ("noack summary --verbose", "with timing, assumptions and each claim"),
    ("noack summary --tables tables", "its tables for a paper, as LaTeX and CSV"),
    ("noack summary runs/latest --json", "all numbers, as JSON"),
])  # fmt: skip
def summary(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    verbose: cli.VerboseOption = False,
    tables: cli.TablesOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Show a run's summary; finalise an interrupted run first.

    Exit status 0: the summary was shown, also that of a failed run.
    """
    from cosim.analysis.run_summary import outcome_of_loop
    from cosim.live.finalize import reopen
    from cosim.output.run_tables import summary_tables
    from cosim.output.run_verdict import print_outcome

    outcome = outcome_of_loop(reopen(chosen_run(run_dir, runs)), loop)
    cli.show(json, outcome.summary.to_json, print_outcome, outcome, verbose=verbose)
    cli.write_tables(summary_tables(outcome.summary), tables, json=json)
    return ExitStatus.OK


@cli.command(cli.RUNS, 40, [
    ("noack view", "the last run, in a window if there is a display"),
    ("noack view runs/latest --web", "in a browser on this machine"),
    ("noack view --loop pendulum-07", "one loop of a run of several, in detail"),
])  # fmt: skip
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
    """
    from cosim.output.viewer.live_viewer import view_recording

    path = chosen_run(recording, runs)
    path = path / file_of_loop(RECORDING_FILE, loop) if path.is_dir() else path
    if (path.parent / SCENARIO_FILE).is_file() and not path.is_file():
        from cosim.live.finalize import write_recording

        with cli.status("writing the recording"):
            write_recording(path.parent, loop)
    if json:
        cli.print_json({"recording": str(path), "exists": path.is_file()})
        return ExitStatus.OK if path.is_file() else ExitStatus.CALLER
    view_recording(path, native=False if web else None)
    return ExitStatus.OK


@cli.command(cli.RUNS, 90, [
    ("noack report", "the report of the last run"),
    ("noack report --format pdf", "with its figures for a paper"),
    ("noack report runs/latest --json", "print the path as JSON"),
])  # fmt: skip
def report(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    again: Annotated[bool, Option("--again")] = False,
    figure_format: cli.FormatOption = None,
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Print the path of a run's report (one HTML page with all figures); write it if missing.

    Options:
        again: Write the report again, even if there is one.
    """
    from cosim.api.runs import open_run
    from cosim.live.finalize import run_report
    from cosim.output.figure_format import figure_files

    chosen = chosen_run(run_dir, runs)
    figure_files(figure_format, width)  # refuses a wrong width before anything is drawn
    path, figures = run_report(chosen, loop, again=again), []
    if figure_format is not None:
        opened = open_run(chosen)
        shown = opened if loop is None else opened.loops[loop]
        figures = shown.save_figures(figure_format, width)
    if json:
        written = {"figures": [str(figure) for figure in figures]} if figures else {}
        cli.print_json({"report": str(path)} | written)
    else:
        print(path, *figures, sep="\n")
    return ExitStatus.OK


@cli.command(cli.RUNS, 70, [
    ("noack replay", "the last run; exit status 1 if a bit differs"),
    ("noack replay runs/latest --json", "as JSON"),
])  # fmt: skip
def replay(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Replay a run's recorded inputs; compare the outputs bit for bit."""
    from cosim.analysis.replay.replay_result import print_replay
    from cosim.analysis.replay.run_replay import replay_run
    from cosim.record.run_directory import changed_since
    from cosim.record.run_record import load_run

    path = chosen_run(run_dir, runs)
    with cli.status("replaying"):
        found = replay_run(load_run(path), loop)
    changed = changed_since(path)
    cli.show(
        json, lambda: found.document() | {"changed_since": changed}, print_replay, found, changed
    )
    return ExitStatus.OK if found.bit_exact else ExitStatus.FAILED


@cli.command(cli.RUNS, 60, [
    ("noack fidelity", "effects of sampling, delay and hold on the last run"),
    ("noack fidelity --out fidelity.png", "with a figure"),
    ("noack fidelity runs/latest --json", "as JSON"),
])  # fmt: skip
def fidelity(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    out: cli.OutOption = None,
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Compare a run with the ideal loop in continuous time, effect by effect.

    Options:
        out: Write a figure of the differences over time (.svg, .png, .pdf).
    """
    from cosim.analysis.fidelity import compute_fidelity
    from cosim.output.figure_files import save_figure
    from cosim.output.run_figures import fidelity_figure
    from cosim.output.run_verdict import print_fidelity
    from cosim.record.run_record import load_record

    path = chosen_run(run_dir, runs)
    with cli.status("comparing"):
        found = compute_fidelity(load_record(path, loop))
        if out is not None:
            save_figure(fidelity_figure(found), out, width)
    cli.show(json, found.as_json, print_fidelity, found)
    return ExitStatus.OK if found.explained else ExitStatus.FAILED


def _known_format(name: str) -> str:
    if name not in FORMATS:
        raise typer.BadParameter(f"'{name}' is not one of {', '.join(FORMATS)}")
    return name


@cli.command(cli.RUNS, 96, [
    ("noack export --format mat", "the last run for MATLAB and Octave"),
    ("noack export --format mcap --out run.mcap", "for Foxglove and PlotJuggler"),
    ("noack export runs/latest --format csv --json", "a folder of CSV files"),
])  # fmt: skip
def export(
    run_dir: cli.RunArgument = None,
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
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    certificates: bool = True,
    json: cli.JsonOption = False,
) -> int:
    """Export a run for other programs: its tables, its summary and its certificates.

    Options:
        file_format: Format of the file, or of the folder's files.
        out: File, or folder of CSV; RUN.mat and so on by default.
        certificates: Certificates of each loop in a file of MATLAB; about a second for each loop.
    """
    from cosim.live.finalize import reopen
    from cosim.output.export import export_run, export_suffix

    chosen = chosen_run(run_dir, runs)
    reopen(chosen)
    name = chosen.resolve().name if loop is None else loop
    path = out or Path(f"{name}{export_suffix(file_format)}")
    with cli.status("exporting"):
        written = export_run(chosen, path, file_format, loop=loop, certificates=certificates)
    if json:
        cli.print_json({"files": [str(path) for path in written]})
    else:
        print(*written, sep="\n")
    return ExitStatus.OK
