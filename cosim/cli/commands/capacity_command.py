"""``noack capacity``: how many loops a link carries."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli import command as cli
from cosim.cli.execute_campaign import Workers, execute_campaign, worker_pool
from noack.core.errors import CallerError, ExitStatus
from noack.runtime.command_line import print_to_stderr

if TYPE_CHECKING:
    from cosim.studies.capacity.capacity_plan import CapacityPlan

Loops = Annotated[
    str | None,
    typer.Option(
        metavar="N,N,...",
        help="Numbers of loops; by default around the number of periodic loops that fit.",
    ),
]
RateBps = Annotated[
    int | None,
    typer.Option(
        help="Rate of the bottleneck, bits per second; by default the scenario's.",
        min=1,
        max=10**12,
    ),
]
Period = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="Period of the periodic loops; by default 0.3 / the fastest eigenvalue of A + BK.",
    ),
]
Deadline = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="Largest delay of an update in the network; by default certificate.network_delay_s, "
        "or the period.",
    ),
]
PolicyOption = Annotated[
    list[str] | None,
    typer.Option(
        "--policy",
        metavar="NAME=TRIGGER",
        help="Compare another trigger, too, e.g. fast='{ policy = \"periodic\", period_s = 0.1 }'.",
    ),
]
Disturbance = Annotated[
    float,
    typer.Option(
        help="Amplitude of a pulse of 0.5 s on the inputs of all loops at once; 0: no such runs."
    ),
]
Draws = Annotated[int, typer.Option(help="Runs at each number of loops.", min=1, max=10_000)]
Seed = Annotated[int, typer.Option(help="Seed of the draws.", min=0, max=2**63 - 1)]
Live = Annotated[
    str | None,
    typer.Option(
        "--confirm",
        metavar="POLICY=N,...",
        help="Confirm these points by live runs, e.g. model=20.",
    ),
]
Out = Annotated[
    Path | None, typer.Option("--out", help="Folder of the study; runs/capacity/NAME by default.")
]


@cli.command(cli.CAMPAIGNS, 30, [
    ("noack capacity shared_bottleneck --rate-bps 50000", "periodic, ZOH-ET and MB-ET"),
    ("noack capacity shared_bottleneck --loops 5,10,20 --draws 8 --confirm model=5", ""),
])  # fmt: skip
def capacity(
    scenario: cli.ScenarioArgument,
    *,
    loops: Loops = None,
    rate_bps: RateBps = None,
    update_period: Period = None,
    late_after: Deadline = None,
    policy: PolicyOption = None,
    disturbance: Disturbance = 1.0,
    draws: Draws = 10,
    seed: Seed = 0,
    confirm: Live = None,
    workers: Workers = None,
    settings: cli.SetOption = None,
    out: Out = None,
    figure_format: cli.FormatOption = None,
    width: cli.WidthOption = None,
    json: cli.JsonOption = False,
) -> int:
    """How many loops a link carries, until guarantee, deadline or cost is exceeded.

    An interrupted study is continued if it is started again with the same folder.

    Exit status 1: a live run failed, or does not agree with the simulation.
    """
    from cosim.live.progress import PatientConsole
    from cosim.output.figure_format import figure_files
    from cosim.studies.capacity import capacity_live, capacity_page
    from cosim.studies.capacity.capacity_criteria import capacities

    start = worker_pool(workers)
    files_of_figures = figure_files(figure_format, width)
    plan = _plan(
        cli.find_scenario(scenario), settings or [], policy or [], loops=loops, rate_bps=rate_bps,
        period_s=update_period, deadline_s=late_after, amplitude=disturbance, draws=draws,
        seed=seed,
    )  # fmt: skip
    chosen = capacity_live.chosen_points(confirm, plan)
    folder = out or cli.DEFAULT_RUNS / "capacity" / plan.scenario.name
    console = PatientConsole(stderr=True)
    done = execute_campaign(console, plan.campaign(), Path("noack capacity"), start, folder=folder)
    points = []
    for policy_name, count in chosen:
        with console.status(f"live: {policy_name}, {count} loops"):
            at = policy_name, count
            points.append(capacity_live.live_point(at, done.summary.found, folder / "live"))
    result = capacity_page.CapacityResult(
        plan, done.summary, capacities(done.summary, done.store), points
    )
    files = [*capacity_page.write(result, folder, files_of_figures), *done.files]
    if json:
        cli.print_json(result.document() | {"made": done.made, "files": [str(f) for f in files]})
    else:
        capacity_page.print_result(cli.console(), result)
        for file in files:
            print(file)
    agree = all(one.status == ExitStatus.OK and not one.outside for one in points)
    return ExitStatus.OK if agree else ExitStatus.FAILED


def _plan(
    path: Path, overrides: list[str], policies: list[str], *, loops: str | None,
    rate_bps: int | None, period_s: float | None, deadline_s: float | None, **more: Any,
) -> "CapacityPlan":  # fmt: skip
    from cosim.studies.capacity import capacity_plan as plans
    from noack.config.scenario_file import load, value_of
    from noack.config.sections.loop_section import NAME_PATTERN

    settings: dict[str, Any] = {}
    for text in overrides:
        key, _, value = text.partition("=")
        settings[key.strip()] = value_of(value, f"--set {key}")
    loaded = load(path, overrides)
    given = loaded.model_copy(update={"loops": None})
    if rate_bps is not None:
        given = plans.with_rate(given, rate_bps)
        stages = [
            one.model_dump(mode="json", exclude_none=True) for one in given.network.impairments
        ]
        settings["network.impairments"] = stages
    settings["loops"] = [{"name": "loop"}]
    rate_bps = plans.bottleneck(given).rate_bps
    for option, seconds in (("--update-period", period_s), ("--late-after", deadline_s)):
        if seconds is not None and not 0 < seconds < given.horizon_s:
            raise CallerError(f"{option} {seconds:g}: between 0 and the horizon of the scenario")
    if period_s is None:
        period_s = plans.sampling_period_s(given)
    period_s = plans.require_multiple(period_s, given)
    deadline_s = deadline_s or given.certificate.network_delay_s or period_s
    settings["certificate.network_delay_s"] = deadline_s
    compared = plans.default_policies(given, period_s)
    for text in policies:
        name, equals, trigger = text.partition("=")
        if not equals or not re.match(NAME_PATTERN, name.strip()) or name.strip() in compared:
            raise CallerError(
                f"--policy {text}: write it as NAME=TRIGGER, with a new name of letters, digits, _ "
                "and -"
            )
        compared[name.strip()] = {"trigger": value_of(trigger, f"--policy {name}")}
    fitting = plans.periodic_loops(given, rate_bps, period_s)
    counts = (
        plans.default_counts(fitting) if loops is None else plans.require_counts(_counts(loops))
    )
    if own := plans.loops_with_own_settings(loaded):
        print_to_stderr(
            "noack capacity: all loops are as at the top level of the scenario, "
            f"without the settings of [[loops]] {', '.join(own)}"
        )
    return plans.CapacityPlan(
        given, path, settings, rate_bps, period_s, deadline_s, counts, compared, **more
    )


def _counts(text: str) -> list[int]:
    try:
        return [int(one) for one in text.split(",")]
    except ValueError:
        raise CallerError(f"--loops {text}: write it as N,N,..., e.g. 5,10,20") from None
