"""``noack design``: a trigger that transmits least, or a gain that tolerates the most losses."""

import math
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import typer
from typer import Option

from cosim.cli import options as opt
from cosim.cli.options import CAMPAIGNS, examples
from cosim.cli.printing import show_written
from cosim.output.figures.figure_format import requested_files
from cosim.record.run_directory import DEFAULT_RUNS
from netem.core.command_line import print_to_stderr
from netem.core.errors import CallerError, ExitStatus

app = typer.Typer()


class DesignAim(StrEnum):
    """What ``noack design`` may choose, and for what."""

    SETTLING = "settling"
    NETWORK = "network"


class DesignGain(StrEnum):
    """The gain with which a trigger is chosen."""

    GIVEN = "given"
    LQR = "lqr"


class CertificateConditions(StrEnum):
    """The conditions of the certificates that a trigger must have."""

    PAPER = "paper"
    SCHEDULE = "schedule"


@app.command(
    rich_help_panel=CAMPAIGNS,
    epilog=examples(
        ("noack design lane_following --settling 14", "the fewest transmissions"),
        (
            "noack design lane_following --settling 14 --bound error=3 --out mine.toml",
            "with a certified bound",
        ),
        (
            "noack design double_integrator --settling 8 --gain lqr --Q '[1, 1]' --json",
            "with another gain",
        ),
        ("noack design lane_periodic --for network", "a gain for the most losses in a row"),
        (
            "noack design unstable_pendulum --for network --period 0.25 --out mine.toml",
            "for a time-triggered loop",
        ),
    ),
)
def design(
    scenario: opt.ScenarioArgument,
    settings: opt.SetOption = None,
    loop: opt.LoopOption = None,
    aim: Annotated[
        DesignAim,
        Option(
            "--for",
            help="`settling`: the trigger with the fewest transmissions that settles in time. "
            "`network`: the gain with which a time-triggered loop bears the most losses in a row, proven.",
        ),
    ] = DesignAim.SETTLING,
    settling: Annotated[
        float | None,
        Option(metavar="SECONDS", help="Largest settling time allowed; required for --for settling."),
    ] = None,
    quantile: Annotated[float, Option(help="Share of the draws that must settle in time.")] = 0.95,
    settle: Annotated[
        float, Option(help="A run has settled when ‖x‖ stays below this share of ‖x(0)‖.")
    ] = 0.02,
    bound: Annotated[
        list[str] | None,
        Option(
            metavar="state=X|error=X",
            help="Largest certified sup‖x‖ (state) or sup‖e_c‖ (error) allowed over the box.",
        ),
    ] = None,
    under: Annotated[
        CertificateConditions,
        Option(help="Conditions of the certificates: the `paper`'s, or the scenario's `schedule`."),
    ] = CertificateConditions.PAPER,
    weights: Annotated[
        str,
        Option(help="Norms to try: `identity`, `given` in the scenario, `input`: by what errors do to u."),
    ] = "identity,input",
    gain: Annotated[
        DesignGain, Option(help="Gain K: `given` in the scenario, or `lqr` of the nominal model.")
    ] = DesignGain.GIVEN,
    Q: opt.StateWeightOption = None,
    R: opt.InputWeightOption = None,
    draws: Annotated[
        int,
        Option(min=20, help="Draws that choose the trigger; the same number of new draws confirm it."),
    ] = 2000,
    seed: opt.SeedOption = 0,
    period: Annotated[
        float | None,
        Option(
            metavar="SECONDS",
            help="With --for network: time between two updates; by default that of a periodic scenario.",
        ),
    ] = None,
    most: Annotated[
        int | None,
        Option(min=0, max=9_999, help="With --for network: most losses in a row to examine; 15 by default."),
    ] = None,
    cost: Annotated[
        float | None,
        Option(
            help="With --for network: largest cost ∫ xᵀQx + uᵀRu dt without losses, as a multiple of "
            "the given loop's; 1.2 by default."
        ),
    ] = None,
    effort: Annotated[
        int | None,
        Option(
            min=0,
            help="With --for network: number of loops that the search may try; 1,500 by default.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        Option(callback=opt.usable_path, help="Write the chosen scenario to this file (TOML)."),
    ] = None,
    page: Annotated[
        Path | None,
        Option(
            callback=opt.usable_path,
            help="File of the page (HTML); runs/design/NAME.html by default.",
        ),
    ] = None,
    figure_format: opt.FigureFormatOption = None,
    width: opt.WidthOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Choose a trigger that transmits least, or a gain that tolerates the most losses.

    Without --for: α, β and the norm with the fewest transmissions that meet your limits. With --for
    network: the gain K of a time-triggered loop, by LQR and a search without gradients; the result is
    proven, as by noack margin.

    Exit status 1: no choice meets the limits or is proven stable, or fresh draws do not confirm it.

    Takes up to two minutes.
    """
    from cosim.cli.cost_weights import cost_weights
    from cosim.cli.execute_run import warn_of_left_out
    from cosim.live.monitoring.progress import work_bar
    from cosim.output.page_kit import save_page
    from cosim.record.run_directory import write_output
    from cosim.studies.design import design_page, design_search
    from cosim.studies.design.design_outcome import design_for_network
    from cosim.studies.design.design_space import families_of
    from cosim.studies.design.network_search import DesignRequest
    from netem.core.file_access import require_suffix
    from noack.scenario.scenario_file import dumps

    figure_files = requested_files(figure_format, width)
    for option, path, suffix in (("--out", out, ".toml"), ("--page", page, ".html")):
        if path is not None:
            require_suffix(path, option, suffix)
    loaded = opt.load_loop(scenario, settings, loop)
    _require_writable(out)
    if aim is DesignAim.NETWORK:
        if settling is not None or bound or gain is not DesignGain.GIVEN:
            raise CallerError("--settling, --bound, --gain: are not for --for network")
        if period is not None and not 1e-6 <= period <= 1e7:
            raise CallerError(f"--period: from 1e-6 to 1e7 seconds, not {period:g}")
        default = DesignRequest()
        request = DesignRequest(
            most=most or default.most,
            period_s=period,
            cost=default.cost if cost is None else cost,
            weights=cost_weights(loaded, Q, R),
            effort=default.effort if effort is None else effort,
        )
        with work_bar("trying gains", lines=True) as bar:
            outcome = design_for_network(loaded, request, bar)
        page = page or DEFAULT_RUNS / "design" / f"{loaded.name}-network.html"
        document = design_page.loop_document(outcome)
        written = save_page(document, page, figure_files)
        if out is not None and outcome.is_certified:
            written.append(write_output(out, outcome.scenario_toml()))
        show_written(document, written, json=json)
        return ExitStatus.OK if outcome.is_certified else ExitStatus.FAILED

    for option, value in (("period", period), ("most", most), ("cost", cost), ("effort", effort)):
        if value is not None:
            raise CallerError(f"--{option}: is for --for network only")
    if settling is None:
        raise CallerError("--settling: give the largest settling time, e.g. --settling 14")
    if not 0 < settling < math.inf:
        raise CallerError(f"--settling: must be positive, not {settling:g}")
    for option, share in (("quantile", quantile), ("settle", settle)):
        if not 0 < share < 1:
            raise CallerError(f"--{option}: must be between 0 and 1, not {share:g}")
    if gain is DesignGain.GIVEN and (Q or R):
        raise CallerError("--Q, --R: are for --gain lqr only")
    warn_of_left_out(loaded)
    limits = design_search.DesignLimits(
        settling, quantile, settle, _bounds(bound or ()), under is CertificateConditions.SCHEDULE
    )
    loaded.require_decaying()
    norms = [norm.strip() for norm in weights.split(",") if norm.strip()]
    regulator = cost_weights(loaded, Q, R) if gain is DesignGain.LQR else None
    families = families_of(loaded, norms, regulator)
    with work_bar("trying candidates", lines=True) as bar:
        result = design_search.design(families, limits, draws=draws, seed=seed, progress=bar)
    page = page or DEFAULT_RUNS / "design" / f"{loaded.name}.html"
    document = design_page.trigger_document(result)
    written = save_page(document, page, figure_files)
    if out is not None and result.feasible:
        written.append(write_output(out, dumps(result.scenario)))
    show_written(document, written, json=json)
    if not result.confirmed:
        print_to_stderr(f"noack: {result.verdict()}")
    return ExitStatus.OK if result.confirmed else ExitStatus.FAILED


def _require_writable(out: Path | None) -> None:
    """Raise CallerError if the scenario has no folder, or would replace a file that is none."""
    from noack.scenario.scenario_file import load

    if out is not None and not out.parent.is_dir():
        raise CallerError(f"--out {out}: there is no folder {out.parent}")
    if out is not None and out.exists():
        try:
            load(out)
        except CallerError:
            message = f"--out {out}: exists, and is no scenario; give another name"
            raise CallerError(message) from None


def _bounds(texts: Sequence[str]) -> dict[Literal["state", "error"], float]:
    """Return the limits of certified bounds; raise CallerError if one is wrong."""
    by_quantity: dict[Literal["state", "error"], float] = {}
    bounded: dict[str, Literal["state", "error"]] = {"state": "state", "error": "error"}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            limit = float(value)
        except ValueError:
            limit = math.nan
        if name not in bounded or not 0 < limit < math.inf:
            raise CallerError(f"--bound {text}: write it as state=X or error=X, X positive")
        if bounded[name] in by_quantity:
            raise CallerError(f"--bound {text}: {name} is given twice")
        by_quantity[bounded[name]] = limit
    return by_quantity
