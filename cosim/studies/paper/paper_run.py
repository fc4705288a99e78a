"""Simulates the ensemble and writes the page, its figures and its numbers."""

import math
from pathlib import Path
from typing import Any

from cosim.output.report.figure_files import save_figure
from cosim.studies.campaign.campaign_workers import local
from cosim.studies.campaign.draw_statistics import quartiles
from cosim.studies.paper.draw_measures import MODES, resolved_draw, simulate_draw
from cosim.studies.paper.paper_campaign import (
    BASE,
    Progress,
    base_scenario,
    load_campaign,
    run_parts,
)
from cosim.studies.paper.paper_claims import claims
from cosim.studies.paper.paper_evidence import evidence
from cosim.studies.paper.paper_figures import draw_figure, ensemble_figure
from cosim.studies.paper.paper_page import render
from cosim.studies.paper.paper_results import REPRESENTED, Results, dumps, results_of
from noack.core.errors import CallerError, MachineError, why

PAGE, FIGURES, RESULTS = "paper.md", "figures", "paper.json"
FEWEST_DRAWS = 4


def reproduce(draws: int, workers: int, progress: Progress | None = None) -> Results:
    """Compute all results of the page.

    Args:
        draws: of the base ensemble.
        workers: number of processes.
        progress: called after each chunk of draws.

    Raises:
        CallerError: there are too few draws.
    """
    if draws < FEWEST_DRAWS:
        raise CallerError(f"--draws {draws}: quartiles need at least {FEWEST_DRAWS} draws")
    _, scenarios = load_campaign()
    with local(workers) as runner:
        parts = run_parts(scenarios, draws, runner, progress)
    representative = results_of(parts, {}).representative
    return results_of(parts, evidence(scenarios[BASE], representative))


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
    written = [folder / PAGE, figures / RESULTS]
    try:
        written[0].write_text(render(results), encoding="utf-8")
        written[1].write_text(dumps(results), encoding="utf-8")
        scenario = base_scenario()
        for mode, name in MODES.items():
            resolved = resolved_draw(scenario, results.representative, mode)
            figure = draw_figure(simulate_draw(resolved), resolved, results.representative)
            written.append(figures / f"paper-{name.lower()}.svg")
            save_figure(figure, written[-1])
        written.append(figures / "paper-ensemble.png")
        save_figure(ensemble_figure(results), written[-1])
    except OSError as error:
        raise MachineError(f"{folder}: the page cannot be written: {why(error)}") from None
    return written


def document(results: Results, written: list[Path]) -> dict[str, Any]:
    """Return the results as JSON: quartiles of the base ensemble, claims, files."""
    found = {
        name: {
            key: value if math.isfinite(value) else None
            for key, value in quartiles(results.column(name))._asdict().items()
        }
        for name in REPRESENTED
    }
    return {
        "draws": results.count(),
        "representative": results.representative,
        "quartiles": found,
        "claims": [claim._asdict() for claim in claims(results)],
        "files": [str(path) for path in written],
    }
