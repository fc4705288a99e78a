"""``noack campaign``, ``paper``, ``capacity``: studies, which make many runs."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.cli.execute_run import Workers, execute_campaign, worker_pool
from cosim.lazy_modules import lazy_modules
from cosim.record.run_directory import DEFAULT_RUNS
from cosim.shipped_files import find_shipped
from noack.core.errors import CallerError, ExitStatus
from noack.core.system_processes import cores
from noack.runtime.command_line import print_to_stderr

with lazy_modules():
    from cosim.output import result_tables
    from cosim.studies.campaign import campaign_file, campaign_grid, campaign_report
    from cosim.studies.capacity import capacity_page, capacity_plan, capacity_result, loop_kinds, study_time
    from cosim.studies.paper import paper_page, published_result
    from cosim.studies.paper import results as paper_results
    from noack.scenario import run_sections, scenario_file


@cli.command(cli.CAMPAIGNS, 10, takes="seconds to minutes, by the number of draws")
def campaign(
    file: Annotated[str, typer.Argument(autocompletion=opt.complete_campaigns)],
    *,
    draws: Annotated[int | None, Option(min=1)] = None,
    workers: Workers = None,
    scheduler: Annotated[str | None, Option(metavar="tcp://HOST:PORT")] = None,
    out: opt.OutOption = None,
    figures: opt.FigureOptions,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
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
    if figure_files is not None and not plan.figures:
        raise CallerError(f"--format: there is no figure; {path} has no [[figures]]")
    folder = out or DEFAULT_RUNS / "campaigns" / plan.name
    summary, _, _, new_runs, files = execute_campaign(
        plan, path, start, folder=folder, draws=draws, figure_files=figure_files
    )
    document = summary.to_json() | {"made": new_runs}
    cli.show_with_files(json, document, files, campaign_report.print_summary, summary)
    cli.write_tables(campaign_report.campaign_tables(summary), tables, json=json)
    return ExitStatus.FAILED if summary.breaches else ExitStatus.OK


@cli.command(cli.THEORY, 30, takes="up to a minute")
def paper(
    name: Annotated[str | None, typer.Argument(autocompletion=opt.complete_papers)] = None,
    *,
    list_names: Annotated[bool, Option("--list")] = False,
    draws: Annotated[int | None, Option(min=1)] = None,
    out: opt.OutOption = None,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Reproduce the paper's Section V, or another published result: published against computed.

    Without a name: a page with figures, tables and verdicts; the runs are those of the campaign
    paper, in runs/campaigns/paper. With a name: a table.

    Exit status 1: a value differs from the published one, and it is not known why.

    Options:
        name: Name of another published result; --list shows them.
        list_names: List the other published results, or show one of these.
        draws: Number of random plants, losses and initial states; 1,000 by default.
        out: Folder for paper.md and its figures; runs/paper by default.

    Examples:
        noack paper   1,000 draws into runs/paper
        noack paper --draws 50 --out paper --json   fewer draws, as JSON
        noack paper --list   the other published results
        noack paper selivanov_fridman   one of them
    """
    if list_names:
        _list_results(paper_results.NAMES if name is None else [name], json=json)
        return ExitStatus.OK
    if name is not None:
        if out is not None or draws is not None:
            raise CallerError("--out, --draws: are for `noack paper` without a name; this has --tables")
        return _reproduce(name, tables, json=json)
    out = out or DEFAULT_RUNS / "paper"
    paper_page.make_folder(out)
    path, folder = find_shipped("paper", "campaigns"), DEFAULT_RUNS / "campaigns" / "paper"
    plan = campaign_file.load(path)
    finished = execute_campaign(plan, path, worker_pool(None), folder=folder, draws=draws)
    with cli.status("computing the examples"):
        numbers, files = paper_page.write_page(finished, out)
    table = campaign_report.claims_table(finished.summary)
    if not json:
        cli.console().print(result_tables.terminal_table(table, left=range(3)))
    document = {
        "draws": finished.summary.draws,
        "representative": numbers["representative"],
        "claims": numbers["summary"]["claims"],
        "files": [str(file) for file in files],
    }
    cli.print_lines(json, document, *files)
    cli.write_tables([table], tables, json=json)
    return ExitStatus.OK


def _list_results(names: Sequence[str], *, json: bool) -> None:
    """Print published results, each with what it is about."""
    known = {name: paper_results.find_result(name).about for name in names}
    cli.print_lines(json, known, *(f"{name:<18} {about}" for name, about in known.items()))


def _reproduce(name: str, tables: Path | None, *, json: bool) -> int:
    """Compute a published result, and print it beside the published values; return the exit status."""
    with cli.status("computing"):
        result = paper_results.reproduce(name)
    cli.show(json, result.to_json, published_result.print_rows, result)
    cli.write_tables([result.table], tables, json=json)
    return ExitStatus.OK if result.as_expected else ExitStatus.FAILED


@opt.option_group
class StudyOptions(opt.ScenarioOptions):
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
        draws: Runs at each number of loops; 6 by default, the fewest that can decide, 10 with
            --thorough.
    """

    thorough: bool = False
    loops: Annotated[str | None, Option(metavar="N,N,...")] = None
    rate_bps: Annotated[int | None, Option(min=1, max=10**12)] = None
    update_period: Annotated[float | None, Option(metavar="SECONDS")] = None
    late_after: Annotated[float | None, Option(metavar="SECONDS")] = None
    policy: Annotated[list[str] | None, Option("--policy", metavar="NAME=TRIGGER")] = None
    disturbance: float | None = None
    draws: Annotated[int | None, Option(min=1, max=10_000)] = None
    seed: opt.SeedOption = 0

    def plan(self) -> "capacity_plan.CapacityPlan":
        """Return what is run; raise CallerError if an option is wrong."""
        defaults = self._defaults()
        path = opt.find_scenario(self.scenario)
        loaded = scenario_file.load(path, self.settings or ())
        settings: dict[str, Any] = dict(map(scenario_file.setting_of, self.settings or ()))
        if self.rate_bps is not None:
            loaded = capacity_plan.with_rate(loaded, self.rate_bps)
            settings["network.impairments"] = [
                impairment.model_dump(mode="json", exclude_none=True)
                for impairment in loaded.network.impairments
            ]
        capacity_plan.bottleneck(loaded)
        for option, seconds in (("--update-period", self.update_period), ("--late-after", self.late_after)):
            if seconds is not None and not 0 < seconds < loaded.horizon_s:
                raise CallerError(f"{option} {seconds:g}: between 0 and the horizon of the scenario")
        kinds = loop_kinds.kinds_of(loaded, self.update_period)
        shortest_s = min(kind.period_s for kind in kinds)
        deadline_s = self.late_after or loaded.certificate.network_delay_s or shortest_s
        settings["certificate.network_delay_s"] = deadline_s
        capacity_plan.require_in_time(loaded, kinds, deadline_s)
        least = loop_kinds.smallest_mixture(kinds)
        if self.loops is None:
            carried = capacity_plan.periodic_loops(loaded, kinds)
            counts = capacity_plan.default_counts(carried, least, defaults)
        else:
            try:
                given_counts = [int(count) for count in self.loops.split(",")]
            except ValueError:
                raise CallerError(f"--loops {self.loops}: write it as N,N,..., e.g. 5,10,20") from None
            counts = capacity_plan.require_counts(given_counts, least)
        return capacity_plan.CapacityPlan(
            scenario=loaded,
            kinds=kinds,
            file=path,
            settings=settings,
            deadline_s=deadline_s,
            counts=counts,
            policies=loop_kinds.policies_of(kinds) | self._policies(kinds),
            amplitude=defaults.amplitude,
            draws=defaults.draws,
            seed=self.seed,
        )

    def _defaults(self) -> "capacity_plan.StudyDefaults":
        defaults = capacity_plan.THOROUGH if self.thorough else capacity_plan.QUICK
        if self.draws is not None:
            defaults = defaults._replace(draws=self.draws)
        if self.disturbance is not None:
            if not math.isfinite(self.disturbance):
                raise CallerError(f"--disturbance {self.disturbance}: expected a finite number")
            defaults = defaults._replace(amplitude=self.disturbance)
        return defaults

    def _policies(self, kinds: "Sequence[loop_kinds.LoopKind]") -> dict[str, dict[str, Any]]:
        """Return the settings of the policies that are compared, too, by name."""
        known = {loop_kinds.PERIODIC, loop_kinds.ZOH, loop_kinds.MODEL}
        by_name: dict[str, dict[str, Any]] = {}
        for text in self.policy or ():
            name, equals, trigger = text.partition("=")
            name = name.strip()
            is_new = name not in known and name not in by_name
            if not equals or not re.match(run_sections.NAME_PATTERN, name) or not is_new:
                raise CallerError(
                    f"--policy {text}: write it as NAME=TRIGGER, with a new name of letters, digits, _ and -"
                )
            value: Any = scenario_file.value_of(trigger, f"--policy {name}")
            by_name[name] = {"loops": [kind.under({"trigger": value}) for kind in kinds]}
        return by_name


@cli.command(cli.CAMPAIGNS, 30, takes="minutes with its defaults")
def capacity(
    study: StudyOptions,
    *,
    confirm: Annotated[str | None, Option("--confirm", metavar="POLICY=N,...")] = None,
    workers: Workers = None,
    out: opt.OutOption = None,
    figures: opt.FigureOptions,
    json: opt.JsonOption = False,
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
        noack capacity shared_bottleneck   periodic, ZOH-ET and MB-ET
        noack capacity shared_bottleneck --thorough   8 numbers of loops, 10 draws, disturbances: 50 minutes
        noack capacity shared_bottleneck --set 'loops=[{ name = "p" }]'   loops of one kind
        noack capacity shared_bottleneck --loops 11,22 --draws 8 --confirm model=11
    """
    start, figure_files = worker_pool(workers), figures.files
    plan = study.plan()
    chosen = capacity_result.chosen_points(confirm, plan)
    name = f"{plan.scenario.name}-thorough" if study.thorough else plan.scenario.name
    folder = out or DEFAULT_RUNS / "capacity" / name
    estimated_s = _announce(study, plan, folder, workers or cores(), len(chosen))
    finished = execute_campaign(plan.campaign(), Path("noack capacity"), start, folder=folder)
    points = []
    for policy, count in chosen:
        with cli.status(f"live: {policy}, {count} loops"):
            simulated = finished.summary.results
            points.append(capacity_result.live_point((policy, count), simulated, folder / "live"))
    capacities = capacity_result.capacities(plan, finished.summary, finished.store)
    result = capacity_page.CapacityResult(plan, finished.summary, capacities, points)
    files = [*capacity_page.write(result, folder, figure_files), *finished.files]
    facts = {"thorough": study.thorough, "estimated_s": estimated_s, "made": finished.made}
    document = result.to_json() | facts
    cli.show_with_files(json, document, files, capacity_page.print_result, result)
    agree = all(point.status == ExitStatus.OK and not point.outside for point in points)
    return ExitStatus.OK if agree else ExitStatus.FAILED


def _announce(
    study: StudyOptions, plan: "capacity_plan.CapacityPlan", folder: Path, workers: int, live: int
) -> float:
    """Print on standard error what is computed and about how long it takes; return the seconds."""
    points = campaign_grid.grid(plan.campaign(), Path("noack capacity"))
    longer = plan if study.thorough else plan.with_defaults(capacity_plan.THOROUGH)
    missing = study_time.missing_loops(plan, points, folder)
    if not missing:
        return 0.0
    cpu_s = study_time.cpu_per_loop_s(points)
    estimated_s = study_time.estimated_s(missing, cpu_s, workers)
    longer_s = study_time.estimated_s(sum(longer.sizes) * longer.draws, cpu_s, workers)
    of_live = f", and {live} live" if live else ""
    sizes = " to ".join(f"{size:,}" for size in sorted({min(plan.sizes), max(plan.sizes)}))
    idle = "an idle core" if workers == 1 else f"{workers} idle cores"
    print_to_stderr(
        f"noack capacity: {len(plan.sizes) * plan.draws:,} runs of {plan.scenario.horizon_s:g} s "
        f"with {sizes} loops{of_live}; the simulation takes "
        f"about {study_time.rough_time(estimated_s)} on {idle}"
        + ("" if longer == plan else f"; --thorough: {study_time.rough_time(longer_s)}")
    )
    return estimated_s
