"""The command that designs a trigger."""

import json as json_module
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from cosim.cli.command import (
    CAMPAIGNS,
    JsonOption,
    ScenarioArgument,
    SetOption,
    command,
    find_scenario,
    print_json,
)
from cosim.record.run_directory import DEFAULT_RUNS
from noack.config.scenario_file import dumps, load, value_of
from noack.core.errors import CallerError, ExitStatus, MachineError
from noack.core.linear_systems import Matrix


@command(CAMPAIGNS, [
    ("noack design lane_following --settling 14", "the fewest transmissions"),
    ("noack design lane_following --settling 14 --bound error=3 --out mine.toml", ""),
    ("noack design double_integrator --settling 8 --gain lqr --Q '[1, 1]' --json", ""),
])  # fmt: skip
def design(
    scenario: ScenarioArgument,
    settling: Annotated[float, typer.Option(metavar="SECONDS", help="Settle within this time.")],
    quantile: Annotated[
        float, typer.Option(help="The share of draws that must settle in time.")
    ] = 0.95,
    settle: Annotated[
        float, typer.Option(help="Settled is when ‖x‖ stays below this share of ‖x(0)‖.")
    ] = 0.02,
    bound: Annotated[
        list[str] | None,
        typer.Option(
            metavar="state=X|error=X",
            help="The certified sup‖x‖ (state) or sup‖e_c‖ (error) over the box is at most X.",
        ),
    ] = None,
    under: Annotated[
        str,
        typer.Option(help="Certified under the `paper`'s conditions or the scenario's `schedule`."),
    ] = "paper",
    weights: Annotated[
        str, typer.Option(help="Norms to choose from: `identity`, `given`, `chosen`.")
    ] = "identity,chosen",
    gain: Annotated[
        str, typer.Option(help="`given` by the scenario, or chosen: `lqr` of the nominal model.")
    ] = "given",
    Q: Annotated[
        str | None,
        typer.Option("--Q", help="LQR's state cost: rows, or a diagonal, e.g. '[1, 1]'."),
    ] = None,
    R: Annotated[str | None, typer.Option("--R", help="LQR's input cost, likewise.")] = None,
    draws: Annotated[
        int, typer.Option(help="To choose by; as many others confirm it.", min=20)
    ] = 2000,
    seed: Annotated[int, typer.Option(help="Of the draws.", min=0, max=2**63 - 1)] = 0,
    settings: SetOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the chosen scenario here (TOML).")
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option("--page", help="The page (HTML); runs/design/NAME.html unless given."),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Choose α, β and the norm for the fewest transmissions that meet your limits."""
    from cosim.live.progress import work_bar
    from cosim.studies.design import design_page as pages
    from cosim.studies.design.candidate_measures import DesignLimits
    from cosim.studies.design.design_run import design as designed
    from cosim.studies.design.loop_families import families_of

    loaded = load(find_scenario(scenario), settings or ())
    loaded.decaying  # noqa: B018 - says so if the policy is another
    for option, value, most in (
        ("settling", settling, math.inf), ("quantile", quantile, 1), ("settle", settle, 1),
    ):  # fmt: skip
        if not 0 < value < most:
            allowed = "positive" if most == math.inf else "between 0 and 1"
            raise CallerError(f"--{option}: must be {allowed}, not {value:g}")
    if under not in ("paper", "schedule"):
        raise CallerError(f'--under: paper or schedule, not "{under}"')
    limits = DesignLimits(settling, quantile, settle, _bounds(bound or []), under == "schedule")
    if out is not None and not out.parent.is_dir():
        raise CallerError(f"--out {out}: there is no folder {out.parent}")
    n, m = loaded.model.dimensions
    if gain not in ("given", "lqr"):
        raise CallerError(f'--gain: given or lqr, not "{gain}"')
    if gain == "given" and (Q or R):
        raise CallerError("--Q, --R: are for --gain lqr only")
    lqr = (_matrix("--Q", Q, n), _matrix("--R", R, m)) if gain == "lqr" else None
    norms = [norm.strip() for norm in weights.split(",") if norm.strip()]
    with work_bar("choosing norms") as progress:
        families = families_of(loaded, norms, lqr, progress)
    with work_bar("trying candidates") as progress:
        found = designed(families, limits, draws=draws, seed=seed, progress=progress)
    written = [_write(page or DEFAULT_RUNS / "design" / f"{loaded.name}.html", pages.page(found))]
    if out is not None and found.feasible:
        written.append(_write(out, dumps(found.scenario)))
    if json:
        print_json(found.document() | {"files": [str(path) for path in written]})
    else:
        pages.print_found(Console(), found)
        for path in written:
            print(path)
    if not found.confirmed:
        typer.echo(f"noack: {found.verdict()}", err=True)
    return ExitStatus.OK if found.confirmed else ExitStatus.FAILED


def _bounds(given: list[str]) -> dict[Any, float]:
    found: dict[Any, float] = {}
    for text in given:
        name, _, value = text.partition("=")
        if name in found:
            raise CallerError(f"--bound {text}: {name} has one already")
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = math.nan
        if name not in ("state", "error") or not 0 < found[name] < math.inf:
            raise CallerError(f"--bound {text}: write it as state=X or error=X, X positive")
    return found


def _matrix(option: str, text: str | None, size: int) -> Matrix:
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


def _write(path: Path, text: str) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        scratch = path.with_name(f".{path.name}.partial")
        scratch.write_text(text, encoding="utf-8")
        scratch.replace(path)
    except OSError as error:
        raise MachineError(f"{path}: cannot be written: {error.strerror or error}") from None
    return path
