"""Simulates the ensemble and writes the page, its figures and its numbers."""

from pathlib import Path
from typing import Any

import numpy as np

from cosim.output.report.figure_files import save_figure
from cosim.studies.paper.draw_measures import simulate_draw
from cosim.studies.paper.ensemble_statistics import quartiles
from cosim.studies.paper.paper_claims import claims
from cosim.studies.paper.paper_conditions import BASE, MODES, load_condition, resolved_draw
from cosim.studies.paper.paper_ensemble import Progress, simulate_ensemble
from cosim.studies.paper.paper_evidence import evidence
from cosim.studies.paper.paper_figures import draw_figure, ensemble_figure
from cosim.studies.paper.paper_page import render
from cosim.studies.paper.paper_results import Results, dumps, results_of
from noack.core.errors import CallerError, MachineError, why

PAGE, FIGURES, RESULTS = "paper.md", "figures", "paper.json"
FEWEST_DRAWS = 4


def reproduce(path: Path, draws: int, workers: int, progress: Progress | None = None) -> Results:
    """Simulate everything that the page says.

    Args:
        path: the paper's scenario.
        draws: of the base ensemble.
        workers: processes.
        progress: is told how far the work is.

    Raises:
        CallerError: too few draws.
    """
    if draws < FEWEST_DRAWS:
        raise CallerError(f"--draws {draws}: quartiles need at least {FEWEST_DRAWS} draws")
    parts = simulate_ensemble(path, draws, workers, progress)
    representative = results_of(parts, {}).representative
    return results_of(parts, evidence(path, representative))


def make_folder(folder: Path) -> None:
    """Make the page's folder, before there is anything to lose.

    Raises:
        MachineError: it cannot be made.
    """
    try:
        (folder / FIGURES).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MachineError(f"{folder}: the page cannot be written: {why(error)}") from None


def write_page(path: Path, results: Results, folder: Path) -> list[Path]:
    """Write page, figures and numbers into the folder made for them; return their paths.

    Raises:
        MachineError: they cannot be written.
    """
    figures = folder / FIGURES
    written = [folder / PAGE, figures / RESULTS]
    try:
        written[0].write_text(render(results), encoding="utf-8")
        written[1].write_text(dumps(results), encoding="utf-8")
        scenario = load_condition(path, BASE)
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
    """What was found, as JSON: quartiles of the base ensemble, claims, files."""
    found: dict[str, Any] = {}
    for mode in MODES:
        for name in ("events", "deliveries", "settled_5_s", "settled_1_s", "gap_min_s"):
            values = quartiles(results.column(f"{mode}.{name}"))._asdict()
            found[f"{mode}.{name}"] = {
                key: value if np.isfinite(value) else None for key, value in values.items()
            }
    return {
        "draws": results.count(),
        "representative": results.representative,
        "quartiles": found,
        "claims": [claim._asdict() for claim in claims(results)],
        "files": [str(path) for path in written],
    }
