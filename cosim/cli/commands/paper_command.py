"""``noack paper``: the paper's Section V, reproduced."""

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import command as cli
from noack.core.errors import ExitStatus


@cli.command(cli.THEORY, 30, [
    ("noack paper", "1,000 draws into runs/paper; takes some minutes"),
    ("noack paper --draws 50 --out paper --json", "fewer draws, as JSON"),
])  # fmt: skip
def paper(
    *,
    draws: Annotated[
        int, typer.Option(help="Number of random plants, losses and initial states.")
    ] = 1000,
    out: Annotated[
        Path, typer.Option("--out", help="Folder for paper.md and its figures.")
    ] = cli.DEFAULT_RUNS / "paper",
    json: cli.JsonOption = False,
) -> int:
    """Reproduce the paper's Section V: a page with figures, tables and verdicts."""
    from cosim.live.progress import PatientConsole, draws_bar
    from cosim.studies.paper import paper_run

    paper_run.make_folder(out)
    with draws_bar(PatientConsole(stderr=True)) as progress:
        results = paper_run.reproduce(draws, cli.cores(), progress)
    found = paper_run.document(results, paper_run.write_page(results, out))
    if json:
        cli.print_json(found)
    else:
        paper_run.print_claims(cli.console(), found)
    return ExitStatus.OK
