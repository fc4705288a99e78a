"""``noack campaign``, ``paper``, ``design``: many runs over a grid, and the choice of a trigger."""

import json as json_module
import math
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from cosim.cli import command as cli
from cosim.cli import completion
from cosim.cli.execute_run import Workers, execute_campaign, worker_pool
from cosim.lazy_modules import lazy_modules
from cosim.shipped_files import find_shipped
from noack.core.errors import CallerError, ExitStatus
from noack.core.file_access import write_whole
from noack.runtime.command_line import print_to_stderr

with lazy_modules():
    from cosim.live import progress
    from cosim.output import result_tables
    from cosim.studies.campaign import campaign_file, campaign_report
    from cosim.studies.design import design_page, design_search, design_space
    from cosim.studies.paper import paper_page
    from noack.core import linear_systems
    from noack.scenario import scenario, scenario_file


@cli.command(cli.CAMPAIGNS, 10)
def campaign(
    file: Annotated[str, typer.Argument(autocompletion=completion.campaigns)],
    *,
    draws: Annotated[int | None, Option(min=1)] = None,
    workers: Workers = None,
    scheduler: Annotated[str | None, Option(metavar="tcp://HOST:PORT")] = None,
    out: cli.OutOption = None,
    figures: cli.FigureOptions,
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

    Examples:
        noack campaign mb_vs_zoh   compare a model with a hold
        noack campaign mansd_sweep --draws 200 --json   fewer draws at each grid point
        noack campaign mb_vs_zoh --scheduler tcp://127.0.0.1:8786   on a Dask cluster
    """
    start, figure_files = worker_pool(workers, scheduler), figures.files
    path = find_shipped(file, "campaigns")
    plan = campaign_file.load(path)
    folder = out or cli.DEFAULT_RUNS / "campaigns" / plan.name
    summary, _, _, made, files = execute_campaign(
        plan, path, start, folder=folder, draws=draws, figure_files=figure_files
    )
    document = summary.document() | {"made": made}
    cli.show_with_files(json, document, files, campaign_report.print_summary, summary)
    cli.write_tables(campaign_report.campaign_tables(summary), tables, json=json)
    return ExitStatus.FAILED if summary.breaches else ExitStatus.OK


@cli.command(cli.THEORY, 30)
def paper(
    *,
    draws: Annotated[int | None, Option(min=1)] = None,
    out: Path = cli.DEFAULT_RUNS / "paper",
    json: cli.JsonOption = False,
) -> None:
    """Reproduce the paper's Section V: a page with figures, tables and verdicts.

    The runs are those of the campaign paper, in runs/campaigns/paper.

    Options:
        draws: Number of random plants, losses and initial states; 1,000 by default.
        out: Folder for paper.md and its figures.

    Examples:
        noack paper   1,000 draws into runs/paper
        noack paper --draws 50 --out paper --json   fewer draws, as JSON
    """
    paper_page.make_folder(out)
    path, folder = find_shipped("paper", "campaigns"), cli.DEFAULT_RUNS / "campaigns" / "paper"
    plan = campaign_file.load(path)
    done = execute_campaign(plan, path, worker_pool(None), folder=folder, draws=draws)
    with cli.status("computing the examples"):
        found, files = paper_page.write_page(done, out)
    if not json:
        table = campaign_report.claims_table(done.summary)
        cli.console().print(result_tables.terminal_table(table, left=range(3)))
    document = {
        "draws": done.summary.draws,
        "representative": found["representative"],
        "claims": found["summary"]["claims"],
        "files": [str(file) for file in files],
    }
    cli.print_lines(json, document, *files)


@cli.option_group
class LimitOptions:
    """What a design must meet.

    Options:
        settling: Largest settling time allowed.
        quantile: Share of the draws that must settle in time.
        settle: A run has settled when ‖x‖ stays below this share of ‖x(0)‖.
        bound: Largest certified sup‖x‖ (state) or sup‖e_c‖ (error) allowed over the box.
        under: Conditions of the certificates: the `paper`'s, or the scenario's `schedule`.
    """

    settling: Annotated[float, Option(metavar="SECONDS")]
    quantile: float = 0.95
    settle: float = 0.02
    bound: Annotated[list[str] | None, Option(metavar="state=X|error=X")] = None
    under: str = "paper"

    def limits(self) -> "design_search.DesignLimits":
        """Return the limits; raise CallerError if one is wrong."""
        for option, most in (("settling", math.inf), ("quantile", 1), ("settle", 1)):
            if not 0 < (value := getattr(self, option)) < most:
                allowed = "positive" if most == math.inf else "between 0 and 1"
                raise CallerError(f"--{option}: must be {allowed}, not {value:g}")
        if self.under not in ("paper", "schedule"):
            raise CallerError(f'--under: paper or schedule, not "{self.under}"')
        return design_search.DesignLimits(
            self.settling, self.quantile, self.settle, self._bounds(), self.under == "schedule"
        )

    def _bounds(self) -> "dict[design_search.Bounded, float]":
        found: dict[design_search.Bounded, float] = {}
        for text in self.bound or ():
            name, _, value = text.partition("=")
            try:
                limit = float(value)
            except ValueError:
                limit = math.nan
            bounded: dict[str, design_search.Bounded] = {"state": "state", "error": "error"}
            if name not in bounded or not 0 < limit < math.inf:
                raise CallerError(f"--bound {text}: write it as state=X or error=X, X positive")
            if bounded[name] in found:
                raise CallerError(f"--bound {text}: {name} is given twice")
            found[bounded[name]] = limit
        return found


@cli.option_group
class GainOptions:
    """The gain of a design.

    Options:
        gain: Gain K: `given` in the scenario, or `lqr` of the nominal model.
        Q: LQR state cost: rows, or a diagonal, e.g. '[1, 1]'.
        R: LQR input cost: rows, or a diagonal.
    """

    gain: str = "given"
    Q: Annotated[str | None, Option("--Q")] = None
    R: Annotated[str | None, Option("--R")] = None

    def regulator(
        self, given: "scenario.Scenario"
    ) -> "tuple[linear_systems.Matrix, linear_systems.Matrix] | None":
        """Return the LQR costs Q (n, n) and R (m, m); None for the scenario's gain.

        Raise CallerError if one is wrong.
        """
        if self.gain not in ("given", "lqr"):
            raise CallerError(f'--gain: given or lqr, not "{self.gain}"')
        if self.gain == "lqr":
            n, m = given.model.dimensions
            return _matrix("--Q", self.Q, n), _matrix("--R", self.R, m)
        if self.Q or self.R:
            raise CallerError("--Q, --R: are for --gain lqr only")
        return None


@cli.command(cli.CAMPAIGNS, 20)
def design(
    given: cli.ScenarioOptions,
    *,
    wanted: LimitOptions,
    weights: str = "identity,chosen",
    feedback: GainOptions,
    draws: Annotated[int, Option(min=20)] = 2000,
    seed: cli.SeedOption = 0,
    out: cli.OutOption = None,
    page: Path | None = None,
    figures: cli.FigureOptions,
    json: cli.JsonOption = False,
) -> int:
    """Choose α, β and the norm: the fewest transmissions that meet your limits.

    Exit status 1: no choice meets the limits, or fresh draws do not confirm it.

    Options:
        weights: Norms to try: `identity`, `given` in the scenario, `chosen` by noack.
        draws: Draws that choose the trigger; the same number of new draws confirm it.
        out: Write the chosen scenario to this file (TOML).
        page: File of the page (HTML); runs/design/NAME.html by default.

    Examples:
        noack design lane_following --settling 14   the fewest transmissions
        noack design lane_following --settling 14 --bound error=3 --out mine.toml
        noack design double_integrator --settling 8 --gain lqr --Q '[1, 1]' --json
    """
    figure_files, loaded = figures.files, given.load()
    loaded.decaying  # noqa: B018 - raises for another policy
    limits = wanted.limits()
    if out is not None and not out.parent.is_dir():
        raise CallerError(f"--out {out}: there is no folder {out.parent}")
    norms = [norm.strip() for norm in weights.split(",") if norm.strip()]
    with progress.work_bar("choosing norms") as bar:
        families = design_space.families_of(loaded, norms, feedback.regulator(loaded), bar)
    with progress.work_bar("trying candidates") as bar:
        found = design_search.design(families, limits, draws=draws, seed=seed, progress=bar)
    path = page or cli.DEFAULT_RUNS / "design" / f"{loaded.name}.html"
    written = design_page.write_page(found, path, figure_files)
    if out is not None and found.feasible:
        written.append(write_whole(out, scenario_file.dumps(found.scenario)))
    cli.show_with_files(json, found.document(), written, design_page.print_found, found)
    if not found.confirmed:
        print_to_stderr(f"noack: {found.verdict()}")
    return ExitStatus.OK if found.confirmed else ExitStatus.FAILED


def _matrix(option: str, text: str | None, size: int) -> "linear_systems.Matrix":
    import numpy as np  # help and completion need none

    if text is None:
        return np.eye(size)
    try:
        value = np.array(scenario_file.value_of(text, option), dtype=np.float64)
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
