"""``noack design``: a trigger that transmits least, or a gain that tolerates the most losses."""

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from typer import Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.cli.execute_run import warn_of_left_out
from cosim.lazy_modules import lazy_modules
from cosim.record.run_directory import DEFAULT_RUNS
from noack.core.errors import CallerError, ExitStatus
from noack.core.file_access import write_whole
from noack.runtime.command_line import print_to_stderr

with lazy_modules():
    from cosim.live.monitoring import progress
    from cosim.studies.design import design_outcome, design_page, design_search, design_space, network_search
    from noack.core import linear_systems
    from noack.scenario import scenario, scenario_file


@opt.option_group
class LimitOptions:
    """What a design must meet.

    Options:
        settling: Largest settling time allowed; required for --for settling.
        quantile: Share of the draws that must settle in time.
        settle: A run has settled when ‖x‖ stays below this share of ‖x(0)‖.
        bound: Largest certified sup‖x‖ (state) or sup‖e_c‖ (error) allowed over the box.
        under: Conditions of the certificates: the `paper`'s, or the scenario's `schedule`.
    """

    settling: Annotated[float | None, Option(metavar="SECONDS")] = None
    quantile: float = 0.95
    settle: float = 0.02
    bound: Annotated[list[str] | None, Option(metavar="state=X|error=X")] = None
    under: str = "paper"

    def limits(self) -> "design_search.DesignLimits":
        """Return the limits; raise CallerError if one is wrong."""
        if self.settling is None:
            raise CallerError("--settling: give the largest settling time, e.g. --settling 14")
        for option, upper in (("settling", math.inf), ("quantile", 1), ("settle", 1)):
            if not 0 < (value := getattr(self, option)) < upper:
                allowed = "positive" if upper == math.inf else "between 0 and 1"
                raise CallerError(f"--{option}: must be {allowed}, not {value:g}")
        if self.under not in ("paper", "schedule"):
            raise CallerError(f'--under: paper or schedule, not "{self.under}"')
        return design_search.DesignLimits(
            self.settling, self.quantile, self.settle, self.bounds(), self.under == "schedule"
        )

    def bounds(self) -> "dict[design_search.BoundedQuantity, float]":
        """Return the limits of certified bounds; raise CallerError if one is wrong."""
        by_quantity: dict[design_search.BoundedQuantity, float] = {}
        for text in self.bound or ():
            name, _, value = text.partition("=")
            try:
                limit = float(value)
            except ValueError:
                limit = math.nan
            bounded: dict[str, design_search.BoundedQuantity] = {"state": "state", "error": "error"}
            if name not in bounded or not 0 < limit < math.inf:
                raise CallerError(f"--bound {text}: write it as state=X or error=X, X positive")
            if bounded[name] in by_quantity:
                raise CallerError(f"--bound {text}: {name} is given twice")
            by_quantity[bounded[name]] = limit
        return by_quantity


class DesignAim(StrEnum):
    """What ``noack design`` may choose, and for what."""

    SETTLING = "settling"
    NETWORK = "network"


@opt.option_group
class NetworkOptions:
    """What a design for a network must meet.

    Options:
        aim: `settling`: the trigger with the fewest transmissions that settles in time. `network`:
            the gain of a time-triggered loop that is proven stable for the largest M.
        period: Time between two updates; by default that of a periodic scenario.
        most: Largest M to examine; 16 by default.
        cost: Largest cost ∫ xᵀQx + uᵀRu dt without losses, as a multiple of the given loop's; 1.2 by
            default.
        effort: Number of loops that the search may try; 1,500 by default.
    """

    aim: Annotated[DesignAim, Option("--for")] = DesignAim.SETTLING
    period: Annotated[float | None, Option(metavar="SECONDS")] = None
    most: Annotated[int | None, Option(min=1, max=10_000)] = None
    cost: float | None = None
    effort: Annotated[int | None, Option(min=0)] = None

    def refuse(self) -> None:
        """Raise CallerError for an option that has no effect for --for settling."""
        for option in ("period", "most", "cost", "effort"):
            if getattr(self, option) is not None:
                raise CallerError(f"--{option}: is for --for network only")

    def request(
        self, weights: "tuple[linear_systems.Matrix, linear_systems.Matrix]"
    ) -> "network_search.DesignRequest":
        """Return what is asked for; raise CallerError if an option is wrong."""
        if self.period is not None and not 1e-6 <= self.period <= 1e7:
            raise CallerError(f"--period: from 1e-6 to 1e7 seconds, not {self.period:g}")
        default = network_search.DesignRequest()
        return network_search.DesignRequest(
            most=self.most or default.most,
            period_s=self.period,
            cost=default.cost if self.cost is None else self.cost,
            weights=weights,
            effort=default.effort if self.effort is None else self.effort,
        )


@opt.option_group
class GainOptions(opt.CostOptions):
    """The gain of a design, and the costs of its regulator.

    Options:
        gain: Gain K: `given` in the scenario, or `lqr` of the nominal model.
    """

    gain: str = "given"

    def regulator(
        self, loaded: "scenario.Scenario"
    ) -> "tuple[linear_systems.Matrix, linear_systems.Matrix] | None":
        """Return the LQR costs, None for the scenario's gain; raise CallerError if one is wrong."""
        if self.gain not in ("given", "lqr"):
            raise CallerError(f'--gain: given or lqr, not "{self.gain}"')
        if self.gain == "lqr":
            return self.matrices(loaded)
        if self.Q or self.R:
            raise CallerError("--Q, --R: are for --gain lqr only")
        return None


@opt.option_group
class DesignFiles:
    """The files of a design.

    Options:
        out: Write the chosen scenario to this file (TOML).
        page: File of the page (HTML); runs/design/NAME.html by default.
    """

    out: opt.OutOption = None
    page: Annotated[Path | None, Option(callback=opt.usable_path)] = None

    def page_of(self, name: str) -> Path:
        """Return the file of the page.

        Raise CallerError if the scenario has no folder, or would replace a file that is none.
        """
        if self.out is not None and not self.out.parent.is_dir():
            raise CallerError(f"--out {self.out}: there is no folder {self.out.parent}")
        if self.out is not None and self.out.exists():
            try:
                scenario_file.load(self.out)
            except CallerError:
                message = f"--out {self.out}: exists, and is no scenario; give another name"
                raise CallerError(message) from None
        return self.page or DEFAULT_RUNS / "design" / f"{name}.html"

    def write(self, scenario_toml: str) -> list[Path]:
        """Write the chosen scenario, if it is wanted; return the written files."""
        return [] if self.out is None else [write_whole(self.out, scenario_toml)]


@cli.command(cli.CAMPAIGNS, 20, takes="up to two minutes")
def design(
    source: opt.OneLoopOptions,
    *,
    network: NetworkOptions,
    requirements: LimitOptions,
    weights: str = "identity,chosen",
    feedback: GainOptions,
    draws: Annotated[int, Option(min=20)] = 2000,
    seed: opt.SeedOption = 0,
    files: DesignFiles,
    figures: opt.FigureOptions,
    json: opt.JsonOption = False,
) -> int:
    """Choose a trigger that transmits least, or a gain that tolerates the most losses.

    Without --for: α, β and the norm with the fewest transmissions that meet your limits. With --for
    network: the gain K of a time-triggered loop, by LQR and a search without gradients; the result is
    proven, as by noack margin.

    Exit status 1: no choice meets the limits or is proven stable, or fresh draws do not confirm it.

    Options:
        weights: Norms to try: `identity`, `given` in the scenario, `chosen` by noack.
        draws: Draws that choose the trigger; the same number of new draws confirm it.

    Examples:
        noack design lane_following --settling 14   the fewest transmissions
        noack design lane_following --settling 14 --bound error=3 --out mine.toml
        noack design double_integrator --settling 8 --gain lqr --Q '[1, 1]' --json
        noack design lane_periodic --for network   a gain for the largest M
        noack design unstable_pendulum --for network --period 0.25 --out mine.toml
    """
    figure_files, loaded = figures.files, source.load()
    if network.aim is not DesignAim.SETTLING:
        if requirements.settling is not None or requirements.bound or feedback.gain != "given":
            raise CallerError(f"--settling, --bound, --gain: are not for --for {network.aim.value}")
        page = files.page_of(f"{loaded.name}-network")
        request = network.request(feedback.matrices(loaded))
        with progress.work_bar("trying gains", lines=True) as bar:
            outcome = design_outcome.design_for_network(loaded, request, bar)
        written = design_page.write_outcome(outcome, page, figure_files)
        written += files.write(outcome.scenario_toml()) if outcome.is_certified else []
        cli.show_with_files(json, outcome.to_json(), written, design_page.print_loop_design, outcome)
        return ExitStatus.OK if outcome.is_certified else ExitStatus.FAILED
    network.refuse()
    warn_of_left_out(loaded)
    page = files.page_of(loaded.name)
    result = _trigger_of(loaded, requirements.limits(), weights, feedback, draws, seed)
    written = design_page.write_page(result, page, figure_files)
    written += files.write(scenario_file.dumps(result.scenario)) if result.feasible else []
    cli.show_with_files(json, result.to_json(), written, design_page.print_trigger_design, result)
    if not result.confirmed:
        print_to_stderr(f"noack: {result.verdict()}")
    return ExitStatus.OK if result.confirmed else ExitStatus.FAILED


def _trigger_of(
    loaded: "scenario.Scenario",
    limits: "design_search.DesignLimits",
    weights: str,
    feedback: GainOptions,
    draws: int,
    seed: int,
) -> "design_search.DesignResult":
    """Choose the trigger with the fewest transmissions that meets the limits."""
    loaded.require_decaying()
    norms = [norm.strip() for norm in weights.split(",") if norm.strip()]
    with progress.work_bar("choosing norms", lines=True) as bar:
        families = design_space.families_of(loaded, norms, feedback.regulator(loaded), bar)
    with progress.work_bar("trying candidates", lines=True) as bar:
        return design_search.design(families, limits, draws=draws, seed=seed, progress=bar)
