"""``noack campaign``, ``paper``, ``design``: many runs over a grid, and the choice of a trigger."""

import json as json_module
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import completion
from cosim.cli.execute_run import Workers, execute_campaign, worker_pool
from noack.core.errors import CallerError, ExitStatus
from noack.core.file_access import write_whole
from noack.runtime.command_line import print_to_stderr

if TYPE_CHECKING:
    from cosim.studies.design.design_search import DesignLimits
    from noack.config.scenario import Scenario
    from noack.core.linear_systems import Matrix


@cli.command(cli.CAMPAIGNS, 10, [
    ("noack campaign mb_vs_zoh", "compare a model with a hold"),
    ("noack campaign mansd_sweep --draws 200 --json", "fewer draws at each grid point"),
    ("noack campaign mb_vs_zoh --scheduler tcp://127.0.0.1:8786", "on a Dask cluster"),
])  # fmt: skip
def campaign(
    file: Annotated[str, Argument(autocompletion=completion.campaigns)],
    *,
    draws: Annotated[int | None, Option(min=1)] = None,
    workers: Workers = None,
    scheduler: Annotated[str | None, Option(metavar="tcp://HOST:PORT")] = None,
    out: cli.OutOption = None,
    figure_format: cli.FormatOption = None,
    width: cli.WidthOption = None,
    tables: cli.TablesOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Run a scenario over a grid of settings, with many random draws at each point.

    An interrupted campaign is continued if it is started again with the same folder.

    Exit status 1: a run exceeded a certified bound.

    Options:
        file: Campaign file (TOML), or the name of a shipped campaign.
        draws: Runs at each grid point; the campaign file's number by default.
        scheduler: Run on the Dask cluster of this scheduler.
        out: Folder of the campaign; runs/campaigns/NAME by default.
    """
    from cosim.live.progress import error_console
    from cosim.output.figure_format import figure_files
    from cosim.shipped_files import find_shipped
    from cosim.studies.campaign.campaign_file import load
    from cosim.studies.campaign.campaign_report import campaign_tables, print_summary

    start = worker_pool(workers, scheduler)
    files_of_figures = figure_files(figure_format, width)
    console = error_console()
    path = find_shipped(file, "campaigns")
    plan = load(path)
    folder = out or cli.DEFAULT_RUNS / "campaigns" / plan.name
    summary, _, _, made, files = execute_campaign(
        console, plan, path, start, folder=folder, draws=draws, figure_files=files_of_figures
    )
    document = summary.document() | {"made": made, "files": [str(file) for file in files]}
    cli.show(json, lambda: document, print_summary, summary)
    cli.print_paths(files, json=json)
    cli.write_tables(campaign_tables(summary), tables, json=json)
    return ExitStatus.FAILED if summary.breaches else ExitStatus.OK


@cli.command(cli.THEORY, 30, [
    ("noack paper", "1,000 draws into runs/paper"),
    ("noack paper --draws 50 --out paper --json", "fewer draws, as JSON"),
])  # fmt: skip
def paper(
    *,
    draws: Annotated[int | None, Option(min=1)] = None,
    out: Path = cli.DEFAULT_RUNS / "paper",
    json: cli.JsonOption = False,
) -> int:
    """Reproduce the paper's Section V: a page with figures, tables and verdicts.

    The runs are those of the campaign paper, in runs/campaigns/paper.

    Options:
        draws: Number of random plants, losses and initial states; 1,000 by default.
        out: Folder for paper.md and its figures.
    """
    from cosim.live.progress import error_console
    from cosim.output.result_tables import terminal_table
    from cosim.shipped_files import find_shipped
    from cosim.studies.campaign.campaign_file import load
    from cosim.studies.campaign.campaign_report import claims_table
    from cosim.studies.paper import paper_page

    paper_page.make_folder(out)
    path, console = find_shipped("paper", "campaigns"), error_console()
    folder = cli.DEFAULT_RUNS / "campaigns" / "paper"
    done = execute_campaign(
        console, load(path), path, worker_pool(None), folder=folder, draws=draws
    )
    with console.status("computing the examples"):
        found, files = paper_page.write_page(done, out)
    names = [str(file) for file in files]
    if json:
        shown = {"draws": done.summary.draws, "representative": found["representative"]}
        cli.print_json(shown | {"claims": found["summary"]["claims"], "files": names})
    else:
        cli.console().print(terminal_table(claims_table(done.summary), left=range(3)))
        print(*names, sep="\n")
    return ExitStatus.OK


@cli.command(cli.CAMPAIGNS, 20, [
    ("noack design lane_following --settling 14", "the fewest transmissions"),
    ("noack design lane_following --settling 14 --bound error=3 --out mine.toml", ""),
    ("noack design double_integrator --settling 8 --gain lqr --Q '[1, 1]' --json", ""),
])  # fmt: skip
def design(
    scenario: cli.ScenarioArgument,
    *,
    settling: Annotated[float, Option(metavar="SECONDS")],
    quantile: float = 0.95,
    settle: float = 0.02,
    bound: Annotated[list[str] | None, Option(metavar="state=X|error=X")] = None,
    under: str = "paper",
    weights: str = "identity,chosen",
    gain: str = "given",
    Q: Annotated[str | None, Option("--Q")] = None,
    R: Annotated[str | None, Option("--R")] = None,
    draws: Annotated[int, Option(min=20)] = 2000,
    seed: cli.SeedOption = 0,
    settings: cli.SetOption = None,
    out: cli.OutOption = None,
    page: Path | None = None,
    figure_format: cli.FormatOption = None,
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Choose α, β and the norm: the fewest transmissions that meet your limits.

    Exit status 1: no choice meets the limits, or fresh draws do not confirm it.

    Options:
        settling: Largest settling time allowed.
        quantile: Share of the draws that must settle in time.
        settle: A run has settled when ‖x‖ stays below this share of ‖x(0)‖.
        bound: Largest certified sup‖x‖ (state) or sup‖e_c‖ (error) allowed over the box.
        under: Conditions of the certificates: the `paper`'s, or the scenario's `schedule`.
        weights: Norms to try: `identity`, `given` in the scenario, `chosen` by noack.
        gain: Gain K: `given` in the scenario, or `lqr` of the nominal model.
        Q: LQR state cost: rows, or a diagonal, e.g. '[1, 1]'.
        R: LQR input cost: rows, or a diagonal.
        draws: Draws that choose the trigger; the same number of new draws confirm it.
        out: Write the chosen scenario to this file (TOML).
        page: File of the page (HTML); runs/design/NAME.html by default.
    """
    from cosim.live.progress import work_bar
    from cosim.output.figure_format import figure_files
    from cosim.studies.design import design_page as pages
    from cosim.studies.design.design_search import design as designed
    from cosim.studies.design.design_space import families_of
    from noack.config.scenario_file import dumps

    files_of_figures = figure_files(figure_format, width)
    loaded = cli.load_scenario(scenario, settings)
    loaded.decaying  # noqa: B018 - raises for another policy
    limits = _limits(settling, quantile, settle, bound or [], under)
    if out is not None and not out.parent.is_dir():
        raise CallerError(f"--out {out}: there is no folder {out.parent}")
    norms = [norm.strip() for norm in weights.split(",") if norm.strip()]
    with work_bar("choosing norms") as progress:
        families = families_of(loaded, norms, _regulator(loaded, gain, Q, R), progress)
    with work_bar("trying candidates") as progress:
        found = designed(families, limits, draws=draws, seed=seed, progress=progress)
    path = page or cli.DEFAULT_RUNS / "design" / f"{loaded.name}.html"
    written = pages.write_page(found, path, files_of_figures)
    if out is not None and found.feasible:
        written.append(write_whole(out, dumps(found.scenario)))
    document = found.document() | {"files": [str(path) for path in written]}
    cli.show(json, lambda: document, pages.print_found, found)
    cli.print_paths(written, json=json)
    if not found.confirmed:
        print_to_stderr(f"noack: {found.verdict()}")
    return ExitStatus.OK if found.confirmed else ExitStatus.FAILED


def _limits(
    settling: float, quantile: float, settle: float, bounds: list[str], under: str
) -> "DesignLimits":
    from cosim.studies.design.design_search import DesignLimits

    for option, value, most in (
        ("settling", settling, math.inf), ("quantile", quantile, 1), ("settle", settle, 1),
    ):  # fmt: skip
        if not 0 < value < most:
            allowed = "positive" if most == math.inf else "between 0 and 1"
            raise CallerError(f"--{option}: must be {allowed}, not {value:g}")
    if under not in ("paper", "schedule"):
        raise CallerError(f'--under: paper or schedule, not "{under}"')
    return DesignLimits(settling, quantile, settle, _bounds(bounds), under == "schedule")


def _bounds(given: list[str]) -> dict[Any, float]:
    found: dict[Any, float] = {}
    for text in given:
        name, _, value = text.partition("=")
        if name in found:
            raise CallerError(f"--bound {text}: {name} is given twice")
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = math.nan
        if name not in ("state", "error") or not 0 < found[name] < math.inf:
            raise CallerError(f"--bound {text}: write it as state=X or error=X, X positive")
    return found


def _regulator(
    loaded: "Scenario", gain: str, Q: str | None, R: str | None
) -> "tuple[Matrix, Matrix] | None":
    """Return the LQR costs Q (n, n) and R (m, m); None for the scenario's gain."""
    if gain not in ("given", "lqr"):
        raise CallerError(f'--gain: given or lqr, not "{gain}"')
    if gain == "lqr":
        n, m = loaded.model.dimensions
        return _matrix("--Q", Q, n), _matrix("--R", R, m)
    if Q or R:
        raise CallerError("--Q, --R: are for --gain lqr only")
    return None


def _matrix(option: str, text: str | None, size: int) -> "Matrix":
    import numpy as np

    from noack.config.scenario_file import value_of

    if text is None:
        return np.eye(size)
    try:
        value = np.array(value_of(text, option), dtype=np.float64)
    except (CallerError, ValueError, TypeError):
        value = np.empty(0)
    if value.ndim == 1:
        value = np.diag(value)
    if value.shape != (size, size) or not np.isfinite(value).all():
        example = json_module.dumps([1] * size)
        raise CallerError(
            f"{option} {text}: expected {size} x {size} numbers by rows, or {size} for the "
            f"diagonal, e.g. '{example}'"
        )
    return value
