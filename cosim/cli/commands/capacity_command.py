"""``noack capacity``: how many loops a link carries."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from cosim.cli import command as cli
from cosim.cli.execute_run import Workers, execute_campaign, worker_pool
from cosim.lazy_modules import lazy_modules
from noack.core.errors import CallerError, ExitStatus
from noack.runtime.command_line import print_to_stderr

with lazy_modules():
    from cosim.studies.campaign import campaign_grid
    from cosim.studies.capacity import capacity_page, capacity_plan, capacity_result
    from noack.scenario import run_sections, scenario_file


@cli.option_group
class StudyOptions(cli.ScenarioOptions):
    """What a study runs.

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
    """

    thorough: bool = False
    loops: Annotated[str | None, Option(metavar="N,N,...")] = None
    rate_bps: Annotated[int | None, Option(min=1, max=10**12)] = None
    update_period: Annotated[float | None, Option(metavar="SECONDS")] = None
    late_after: Annotated[float | None, Option(metavar="SECONDS")] = None
    policy: Annotated[list[str] | None, Option("--policy", metavar="NAME=TRIGGER")] = None
    disturbance: float | None = None
    draws: Annotated[int | None, Option(min=1, max=10_000)] = None
    seed: cli.SeedOption = 0

    def plan(self) -> "capacity_plan.CapacityPlan":
        """Return what is run; raise CallerError if an option is wrong."""
        depth = self._depth()
        path = cli.find_scenario(self.scenario)
        settings: dict[str, Any] = {}
        for text in self.settings or ():
            key, _, value = text.partition("=")
            settings[key.strip()] = scenario_file.value_of(value, f"--set {key}")
        given = scenario_file.load(path, self.settings or ())
        if self.rate_bps is not None:
            given = capacity_plan.with_rate(given, self.rate_bps)
            settings["network.impairments"] = [
                impairment.model_dump(mode="json", exclude_none=True)
                for impairment in given.network.impairments
            ]
        capacity_plan.bottleneck(given)
        for option, seconds in (
            ("--update-period", self.update_period), ("--late-after", self.late_after),
        ):  # fmt: skip
            if seconds is not None and not 0 < seconds < given.horizon_s:
                raise CallerError(
                    f"{option} {seconds:g}: between 0 and the horizon of the scenario"
                )
        kinds = capacity_plan.kinds_of(given, self.update_period)
        shortest_s = min(kind.period_s for kind in kinds)
        deadline_s = self.late_after or given.certificate.network_delay_s or shortest_s
        settings["certificate.network_delay_s"] = deadline_s
        least = capacity_plan.smallest_mixture(kinds)
        if self.loops is None:
            carried = capacity_plan.periodic_loops(given, kinds)
            counts = capacity_plan.default_counts(carried, least, depth)
        else:
            counts = capacity_plan.require_counts(_counts(self.loops), least)
        return capacity_plan.CapacityPlan(
            scenario=given, kinds=kinds, file=path, settings=settings, deadline_s=deadline_s,
            counts=counts, policies=capacity_plan.policies_of(kinds) | self._policies(kinds),
            amplitude=depth.amplitude, draws=depth.draws, seed=self.seed,
        )  # fmt: skip

    def _depth(self) -> "capacity_plan.Depth":
        depth = capacity_plan.THOROUGH if self.thorough else capacity_plan.QUICK
        if self.draws is not None:
            depth = depth._replace(draws=self.draws)
        if self.disturbance is not None:
            if not math.isfinite(self.disturbance):
                raise CallerError(f"--disturbance {self.disturbance}: should be a finite number")
            depth = depth._replace(amplitude=self.disturbance)
        return depth

    def _policies(self, kinds: "Sequence[capacity_plan.Kind]") -> dict[str, dict[str, Any]]:
        """Return the settings of the policies that are compared, too, by name."""
        known = {capacity_plan.PERIODIC, capacity_plan.ZOH, capacity_plan.MODEL}
        found: dict[str, dict[str, Any]] = {}
        for text in self.policy or ():
            name, equals, trigger = text.partition("=")
            name = name.strip()
            is_new = name not in known and name not in found
            if not equals or not re.match(run_sections.NAME_PATTERN, name) or not is_new:
                raise CallerError(
                    f"--policy {text}: write it as NAME=TRIGGER, with a new name of letters, "
                    "digits, _ and -"
                )
            value: Any = scenario_file.value_of(trigger, f"--policy {name}")
            found[name] = {"loops": [kind.under({"trigger": value}) for kind in kinds]}
        return found


@cli.command(cli.CAMPAIGNS, 30)
def capacity(
    study: StudyOptions,
    *,
    confirm: Annotated[str | None, Option("--confirm", metavar="POLICY=N,...")] = None,
    workers: Workers = None,
    out: cli.OutOption = None,
    figures: cli.FigureOptions,
    json: cli.JsonOption = False,
) -> int:
    """How many loops a link carries, until guarantee, deadline or cost is exceeded.

    Different loops keep their proportions: the answer is a multiple of the given [[loops]].

    The time is estimated before the start. The default is a rough study with few runs;
    with --thorough it is precise. An interrupted study is continued if it is started again with
    the same folder.

    Exit status 1: a live run failed, or does not agree with the simulation.

    Options:
        confirm: Confirm these points by live runs, e.g. model=20.
        out: Folder of the study; runs/capacity/NAME by default, or NAME-thorough.

    Examples:
        noack capacity shared_bottleneck   periodic, ZOH-ET and MB-ET: below a minute on two cores
        noack capacity shared_bottleneck --thorough   finite intervals, in an hour or less
        noack capacity shared_bottleneck --set 'loops=[{ name = "p" }]'   loops of one kind
        noack capacity shared_bottleneck --loops 11,22 --draws 8 --confirm model=11
    """
    start, figure_files = worker_pool(workers), figures.files
    plan = study.plan()
    chosen = capacity_result.chosen_points(confirm, plan)
    name = f"{plan.scenario.name}-thorough" if study.thorough else plan.scenario.name
    folder = out or cli.DEFAULT_RUNS / "capacity" / name
    estimated_s = _announce(study, plan, folder, workers or cli.cores(), len(chosen))
    done = execute_campaign(plan.campaign(), Path("noack capacity"), start, folder=folder)
    points = []
    for policy, count in chosen:
        with cli.status(f"live: {policy}, {count} loops"):
            found = done.summary.found
            points.append(capacity_result.live_point((policy, count), found, folder / "live"))
    capacities = capacity_result.capacities(plan, done.summary, done.store)
    result = capacity_page.CapacityResult(plan, done.summary, capacities, points)
    files = [*capacity_page.write(result, folder, figure_files), *done.files]
    about = {"thorough": study.thorough, "estimated_s": estimated_s, "made": done.made}
    document = result.document() | about
    cli.show_with_files(json, document, files, capacity_page.print_result, result)
    agree = all(point.status == ExitStatus.OK and not point.outside for point in points)
    return ExitStatus.OK if agree else ExitStatus.FAILED


def _announce(
    study: StudyOptions, plan: "capacity_plan.CapacityPlan", folder: Path, workers: int, live: int
) -> float:
    """Print on standard error what is computed and about how long it takes; return the seconds."""
    points = campaign_grid.grid(plan.campaign(), Path("noack capacity"))
    longer = plan if study.thorough else plan.with_depth(capacity_plan.THOROUGH)
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


def _counts(text: str) -> list[int]:
    try:
        return [int(count) for count in text.split(",")]
    except ValueError:
        raise CallerError(f"--loops {text}: write it as N,N,..., e.g. 5,10,20") from None
