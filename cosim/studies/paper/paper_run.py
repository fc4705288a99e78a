"""Simulates the ensemble; writes the page, its figures and its numbers; prints the claims."""

import math
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from cosim.output.figure_files import save_figure
from cosim.simulation.continuous import run_continuous
from cosim.studies.campaign.campaign_workers import local
from cosim.studies.campaign.chunk_store import Progress
from cosim.studies.campaign.metrics import quartiles
from cosim.studies.paper.paper_campaign import BASE, MODES, load_campaign, resolved_draw, run_parts
from cosim.studies.paper.paper_claims import PaperVerdict, claims
from cosim.studies.paper.paper_evidence import evidence
from cosim.studies.paper.paper_figures import draw_figure, ensemble_figure
from cosim.studies.paper.paper_page import render
from cosim.studies.paper.paper_results import REPRESENTED, Results, dumps, results_of
from noack.core.errors import CallerError, MachineError, why
from noack.core.file_access import write_whole

PAGE, FIGURES, RESULTS = "paper.md", "figures", "paper.json"
FEWEST_DRAWS = 4
_STYLES = {
    PaperVerdict.CONFIRMED: "green",
    PaperVerdict.PARTLY: "yellow",
    PaperVerdict.NOT_CONFIRMED: "bold red",
}


def reproduce(draws: int, workers: int, progress: Progress | None = None) -> Results:
    """Compute all results of the page for a base ensemble of this number of draws.

    Raises:
        CallerError: there are too few draws.
    """
    if draws < FEWEST_DRAWS:
        raise CallerError(f"--draws {draws}: quartiles need at least {FEWEST_DRAWS} draws")
    with local(workers) as runner:
        parts = run_parts(draws, runner, progress)
    representative = results_of(parts, {}).representative
    return results_of(parts, evidence(load_campaign()[1][BASE], representative))


def make_folder(folder: Path) -> None:
    """Make the page's folder before the simulations start.

    Raises:
        MachineError: it cannot be made.
    """
    try:
        (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MachineError(f"{folder}: the page cannot be written: {why(error)}") from None


def write_page(results: Results, folder: Path) -> list[Path]:
    """Write page, figures and numbers into the folder made for them; return their paths.

    Raises:
        MachineError: they cannot be written.
    """
    figures = folder / FIGURES
    written = [
        write_whole(folder / PAGE, render(results)),
        write_whole(figures / RESULTS, dumps(results)),
    ]
    drawn = {"ensemble.png": ensemble_figure(results)}
    for mode, name in MODES.items():
        resolved = resolved_draw(load_campaign()[1][BASE], results.representative, mode)
        run = run_continuous(resolved)
        drawn[f"{name.lower()}.svg"] = draw_figure(run, resolved, results.representative)
    for name, figure in drawn.items():
        written.append(figures / f"paper-{name}")
        save_figure(figure, written[-1])
    return written


def document(results: Results, written: list[Path]) -> dict[str, Any]:
    """Return the results as JSON: quartiles of the base ensemble, claims, files."""
    found = {name: quartiles(results.column(name))._asdict() for name in REPRESENTED}
    return {
        "draws": results.count(),
        "representative": results.representative,
        "quartiles": {
            name: {key: value if math.isfinite(value) else None for key, value in one.items()}
            for name, one in found.items()
        },
        "claims": [claim._asdict() for claim in claims(results)],
        "files": [str(path) for path in written],
    }


def print_claims(console: Console, found: dict[str, Any]) -> None:
    """Print the claims and the paths of a :func:`document`."""
    table = Table(title=f"Section V over {found['draws']:,} draws", show_lines=True)
    for heading in ("the paper says", "verdict", "numbers"):
        table.add_column(heading)
    for claim in found["claims"]:
        style = _STYLES[claim["verdict"]]
        table.add_row(claim["gist"], f"[{style}]{claim['verdict']}[/]", claim["why"])
    console.print(table)
    for file in found["files"]:
        console.print(file, highlight=False, soft_wrap=True, markup=False)
