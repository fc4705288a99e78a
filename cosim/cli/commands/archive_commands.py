"""``noack archive``, ``reproduce``, ``collect``, ``compare``: runs as files, and several runs."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import completion
from cosim.record.run_directory import chosen_run
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 92, [
    ("noack archive", "the last run, as NAME.noack.zip in this folder"),
    ("noack archive runs/latest --out result.noack.zip --json", "to another file"),
])  # fmt: skip
def archive(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    out: cli.OutOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Archive a run: one file with everything that its repetition needs.

    `noack reproduce` repeats it.

    Options:
        out: File of the archive; NAME.noack.zip in this folder by default.
    """
    from cosim.studies.run_archive import SUFFIX, write_archive

    chosen = chosen_run(run_dir, runs)
    path = out or Path(f"{chosen.resolve().name}{SUFFIX}")
    with cli.status("archiving"):
        manifest = write_archive(chosen, path)
    if json:
        cli.print_json({"archive": str(path)} | manifest.model_dump(mode="json"))
    else:
        print(path)
    return ExitStatus.OK


@cli.command(cli.RUNS, 94, [
    ("noack reproduce result.noack.zip", "exit status 1 if a bit differs"),
    ("noack reproduce result.noack.zip --into again --json", "keep both runs; print JSON"),
])  # fmt: skip
def reproduce(
    file: Annotated[Path, Argument(metavar="FILE")],
    *,
    run_code: Annotated[bool, Option("--run-code")] = False,
    long: Annotated[bool, Option("--long")] = False,
    into: Path | None = None,
    json: cli.JsonOption = False,
) -> int:
    """Repeat an archived run: simulate it again, or replay its record, bit for bit.

    Versions, machine and numbers that differ are listed. Exit status 1: a bit differs.

    Options:
        file: Archive of a run.
        run_code: Run the code that the archive contains, if its plant, trigger or controller is a
            Python class or an FMU.
        long: Repeat a run of more than a million steps, too.
        into: Keep the archived run and its repetition in this new folder.
    """
    from cosim.studies.run_archive import print_repetition, repeat_archive

    with cli.status("repeating"):
        found = repeat_archive(file, run_code=run_code, long=long, into=into)
    cli.show(json, found.to_json, print_repetition, found)
    return ExitStatus.OK if found.bit_exact else ExitStatus.FAILED


@cli.command(cli.RUNS, 55, [
    ("noack collect runs/latest robot:noack/runs/RUN", "by scp from the host robot"),
    ("noack collect runs/latest copy", "from a folder that was copied here"),
])  # fmt: skip
def collect(
    run_dir: Annotated[Path, Argument()],
    sources: Annotated[list[str], Argument()],
    *,
    json: cli.JsonOption = False,
) -> int:
    """Add what processes on other hosts kept of a run, and finalise it again.

    A process that was invited keeps its rows on its host when the recorder is out of reach at the
    end. It then prints their folder.

    Options:
        run_dir: Run directory.
        sources: Folders named by the processes: FOLDER, or HOST:FOLDER for scp.
    """
    from cosim.live.finalize import reopen
    from cosim.output.run_verdict import print_outcome
    from cosim.record import collection
    from cosim.record.run_directory import chosen_run
    from noack.runtime.command_line import print_to_stderr

    run_dir = chosen_run(run_dir, cli.DEFAULT_RUNS)
    outcome = reopen(run_dir)  # refuses a run that is under way
    for source in sources:
        merged, roles = collection.collect(run_dir, source, reopen)
        outcome = replace(merged, run_dir=run_dir)
        print_to_stderr(f"noack: {source}: took what {', '.join(roles) or 'no process'} kept")
    cli.show(json, outcome.summary.to_json, print_outcome, outcome)
    return ExitStatus.OK


@cli.command(cli.RUNS, 80, [
    ("noack compare runs/A runs/B", "key numbers, and a page with the curves overlaid"),
    ("noack compare runs/A runs/B runs/C --out overlay.png", "the overlay as a picture"),
    ("noack compare runs/A:left runs/A:right", "two loops of a run"),
    ("noack compare runs/A runs/B --json", "as JSON"),
])  # fmt: skip
def compare(
    directories: Annotated[
        list[Path], Argument(metavar="RUN...", autocompletion=completion.run_directories)
    ],
    *,
    out: Path = cli.DEFAULT_RUNS / "comparison.html",
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Compare runs: key numbers, settings that differ, curves overlaid.

    Options:
        directories: Two to seven run directories, live or simulated; RUN:NAME is a loop.
        out: File of the overlay: a page (.html), or a figure (.svg, .png, .pdf).
    """
    from cosim.output.result_tables import ResultTable, terminal_table
    from cosim.studies.run_comparison import compare_runs

    with cli.status("comparing"):
        found = compare_runs(directories)
        found.save(out, width)
    if json:
        cli.print_json(found.to_json() | {"overlay": str(out)})
        return ExitStatus.OK
    console = cli.console()
    for run in found.runs:
        console.print(f"{run.label}  {run.title}  {run.directory}",
                      markup=False, highlight=False, soft_wrap=True)  # fmt: skip
    labels = [run.label for run in found.runs]
    tables = {"key numbers (in brackets: difference to A)": found.rows}
    if found.settings:
        tables["settings that differ"] = found.setting_rows
    for title, rows in tables.items():
        console.print(terminal_table(ResultTable("", title, ("", *labels), rows)))
    console.print(f"overlay: {out}", markup=False, highlight=False, soft_wrap=True)
    return ExitStatus.OK
