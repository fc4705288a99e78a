"""``noack capacity``: how many loops a link carries."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Option

from cosim.cli import command as cli
from cosim.cli.execute_run import Workers, execute_campaign, worker_pool
from noack.core.errors import CallerError, ExitStatus
from noack.runtime.command_line import print_to_stderr

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cosim.studies.capacity.capacity_plan import CapacityPlan, Depth, Kind


@cli.command(cli.CAMPAIGNS, 30, [
    ("noack capacity shared_bottleneck", "periodic, ZOH-ET and MB-ET: below a minute on two cores"),
    ("noack capacity shared_bottleneck --thorough", "finite intervals, in an hour or less"),
    ("noack capacity shared_bottleneck --set 'loops=[{ name = \"p\" }]'", "loops of one kind"),
    ("noack capacity shared_bottleneck --loops 11,22 --draws 8 --confirm model=11", ""),
])  # fmt: skip
def capacity(
    scenario: cli.ScenarioArgument,
    *,
    thorough: bool = False,
    loops: Annotated[str | None, Option(metavar="N,N,...")] = None,
    rate_bps: Annotated[int | None, Option(min=1, max=10**12)] = None,
    update_period: Annotated[float | None, Option(metavar="SECONDS")] = None,
    late_after: Annotated[float | None, Option(metavar="SECONDS")] = None,
    policy: Annotated[list[str] | None, Option("--policy", metavar="NAME=TRIGGER")] = None,
    disturbance: float | None = None,
    draws: Annotated[int | None, Option(min=1, max=10_000)] = None,
    seed: cli.SeedOption = 0,
    confirm: Annotated[str | None, Option("--confirm", metavar="POLICY=N,...")] = None,
    workers: Workers = None,
    settings: cli.SetOption = None,
    out: cli.OutOption = None,
    figure_format: cli.FormatOption = None,
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """How many loops a link carries, until guarantee, deadline or cost is exceeded.

    Different loops keep their proportions: the answer is a multiple of the given [[loops]].

    The time is estimated before the start. The default is a rough study with few runs;
    with --thorough it is precise. An interrupted study is continued if it is started again with
    the same folder.

    Exit status 1: a live run failed, or does not agree with the simulation.

    Options:
        thorough: More numbers of loops, 10 draws, and runs with a common disturbance: about 50
            times as long.
        loops: Numbers of loops in all; by default around the number of periodic loops that fit. Of
            different loops, multiples of the smallest number with their proportions.
        rate_bps: Rate of the bottleneck, bits per second; by default the scenario's.
        update_period: Period of the periodic loops; by default 0.3 / the fastest eigenvalue of
            A + BK.
        late_after: Largest delay of an update in the network; by default
            certificate.network_delay_s, or the period.
        policy: Compare another trigger, too, e.g. fast='{ policy = "periodic", period_s = 0.1 }'.
        disturbance: Amplitude of a pulse of 0.5 s on the inputs of all loops at once; 0: no such
            runs, the default. With --thorough 1.
        draws: Runs at each number of loops; 1 by default, 10 with --thorough.
        confirm: Confirm these points by live runs, e.g. model=20.
        out: Folder of the study; runs/capacity/NAME by default, or NAME-thorough.
    """
    from cosim.live.progress import error_console
    from cosim.output.figure_format import figure_files
    from cosim.studies.capacity import capacity_page, capacity_result
    from cosim.studies.capacity.capacity_plan import QUICK, THOROUGH

    start = worker_pool(workers)
    files_of_figures = figure_files(figure_format, width)
    depth = THOROUGH if thorough else QUICK
    if draws is not None:
        depth = depth._replace(draws=draws)
    if disturbance is not None:
        if not math.isfinite(disturbance):
            raise CallerError(f"--disturbance {disturbance}: should be a finite number")
        depth = depth._replace(amplitude=disturbance)
    plan = _plan(
        cli.find_scenario(scenario), settings or [], policy or [], depth, loops=loops,
        rate_bps=rate_bps, period_s=update_period, deadline_s=late_after, seed=seed,
    )  # fmt: skip
    chosen = capacity_result.chosen_points(confirm, plan)
    name = f"{plan.scenario.name}-thorough" if thorough else plan.scenario.name
    folder = out or cli.DEFAULT_RUNS / "capacity" / name
    console = error_console()
    estimated_s = _announce(plan, folder, workers or cli.cores(), len(chosen), thorough=thorough)
    done = execute_campaign(console, plan.campaign(), Path("noack capacity"), start, folder=folder)
    points = []
    for policy_name, count in chosen:
        with console.status(f"live: {policy_name}, {count} loops"):
            at = policy_name, count
            points.append(capacity_result.live_point(at, done.summary.found, folder / "live"))
    result = capacity_page.CapacityResult(
        plan, done.summary, capacity_result.capacities(plan, done.summary, done.store), points
    )
    files = [*capacity_page.write(result, folder, files_of_figures), *done.files]
    about = {"thorough": thorough, "estimated_s": estimated_s, "made": done.made}
    document = result.document() | about | {"files": [str(file) for file in files]}
    cli.show(json, lambda: document, capacity_page.print_result, result)
    cli.print_paths(files, json=json)
    agree = all(point.status == ExitStatus.OK and not point.outside for point in points)
    return ExitStatus.OK if agree else ExitStatus.FAILED


def _announce(
    plan: "CapacityPlan", folder: Path, workers: int, live: int, *, thorough: bool
) -> float:
    """Print on standard error what is computed and about how long it takes; return the seconds."""
    from cosim.studies.campaign.campaign_grid import grid
    from cosim.studies.capacity import capacity_result
    from cosim.studies.capacity.capacity_plan import THOROUGH

    points = grid(plan.campaign(), Path("noack capacity"))
    longer = plan if thorough else plan.with_depth(THOROUGH)
    missing = capacity_result.missing_loops(plan, points, folder)
    if not missing:
        return 0.0
    cpu_s = capacity_result.cpu_per_loop_s(points)
    estimated_s = capacity_result.estimated_s(missing, cpu_s, workers)
    longer_s = capacity_result.estimated_s(sum(longer.sizes) * longer.draws, cpu_s, workers)
    of_live = f", and {live} live" if live else ""
    idle = "an idle core" if workers == 1 else f"{workers} idle cores"
    print_to_stderr(
        f"noack capacity: {len(plan.sizes) * plan.draws:,} runs of {plan.scenario.horizon_s:g} s "
        f"with {min(plan.sizes):,} to {max(plan.sizes):,} loops{of_live}; the simulation takes "
        f"about {capacity_result.time_text(estimated_s)} on {idle}"
        + ("" if longer == plan else f"; --thorough: {capacity_result.time_text(longer_s)}")
    )
    return estimated_s


def _plan(
    path: Path, overrides: list[str], policies: list[str], depth: "Depth", *, loops: str | None,
    rate_bps: int | None, period_s: float | None, deadline_s: float | None, seed: int,
) -> "CapacityPlan":  # fmt: skip
    from cosim.studies.capacity import capacity_plan as plans
    from noack.config.scenario_file import load, value_of

    settings: dict[str, Any] = {}
    for text in overrides:
        key, _, value = text.partition("=")
        settings[key.strip()] = value_of(value, f"--set {key}")
    given = load(path, overrides)
    if rate_bps is not None:
        given = plans.with_rate(given, rate_bps)
        stages = [
            impairment.model_dump(mode="json", exclude_none=True)
            for impairment in given.network.impairments
        ]
        settings["network.impairments"] = stages
    plans.bottleneck(given)
    for option, seconds in (("--update-period", period_s), ("--late-after", deadline_s)):
        if seconds is not None and not 0 < seconds < given.horizon_s:
            raise CallerError(f"{option} {seconds:g}: between 0 and the horizon of the scenario")
    kinds = plans.kinds_of(given, period_s)
    shortest_s = min(kind.period_s for kind in kinds)
    deadline_s = deadline_s or given.certificate.network_delay_s or shortest_s
    settings["certificate.network_delay_s"] = deadline_s
    compared = plans.policies_of(kinds) | _more_policies(policies, kinds)
    least = plans.smallest_mixture(kinds)
    if loops is None:
        counts = plans.default_counts(plans.periodic_loops(given, kinds), least, depth)
    else:
        counts = plans.require_counts(_counts(loops), least)
    return plans.CapacityPlan(
        given, kinds, path, settings, deadline_s, counts, compared, depth.amplitude, depth.draws,
        seed,
    )  # fmt: skip


def _more_policies(policies: list[str], kinds: "Sequence[Kind]") -> dict[str, dict[str, Any]]:
    from cosim.studies.capacity.capacity_plan import MODEL, PERIODIC, ZOH
    from noack.config.run_sections import NAME_PATTERN
    from noack.config.scenario_file import value_of

    found: dict[str, dict[str, Any]] = {}
    for text in policies:
        name, equals, trigger = text.partition("=")
        name = name.strip()
        if not equals or not re.match(NAME_PATTERN, name) or name in {PERIODIC, ZOH, MODEL, *found}:
            raise CallerError(
                f"--policy {text}: write it as NAME=TRIGGER, with a new name of letters, digits, _ "
                "and -"
            )
        change = {"trigger": value_of(trigger, f"--policy {name}")}
        found[name] = {"loops": [kind.under(change) for kind in kinds]}
    return found


def _counts(text: str) -> list[int]:
    try:
        return [int(count) for count in text.split(",")]
    except ValueError:
        raise CallerError(f"--loops {text}: write it as N,N,..., e.g. 5,10,20") from None
