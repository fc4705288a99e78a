"""``noack certify``, ``margin``, ``adversary``, ``cost``: all losses, bad ones, random ones."""

from collections.abc import Callable, Iterable
from enum import StrEnum
from functools import partial
from typing import Annotated

import typer
from typer import Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.cli.execute_run import LiveOptions, run_processes, warn_of_left_out
from cosim.lazy_modules import lazy_modules
from cosim.record.run_directory import DEFAULT_RUNS
from noack.core.errors import CallerError, ExitStatus
from noack.runtime.command_line import StopRequestError, print_to_stderr

with lazy_modules():
    import cosim.analysis.adversary.worst_run as worst_run
    from cosim.analysis import adversary as adversary_search
    from cosim.analysis import certificates, margin_search, mean_cost
    from cosim.live.monitoring import progress
    from cosim.output import certificate_report
    from cosim.output.export import mat_export
    from noack.scenario import resolution, scenario
    from noack.theory.certificates import scenario_certificates


@cli.command(
    cli.THEORY,
    10,
    takes="two seconds; 10 s for a nonlinear plant; half a minute where events are due after many tests",
)
def certify(
    source: opt.OneLoopOptions,
    *,
    weight: str = "given",
    late: Annotated[int | None, Option(min=0, max=1000)] = None,
    tables: opt.TablesOption = None,
    out: opt.OutOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Compute the bounds that are guaranteed for a scenario, and their conditions.

    If there are none for the given norm, those of a norm that noack chooses follow, with the lines
    for the scenario file. If the plant is not linear, the model is certified as the plant.

    Exit status 1: nothing can be certified, not even under the paper's conditions.

    Options:
        weight: Norm of the trigger: `given` in the scenario, `identity`, or `chosen` by noack.
        late: Allowed lateness in steps of the plant; certificate.late_periods by default.
        out: Write the certificates for MATLAB and Octave (.mat).

    Examples:
        noack certify lane_following   its plant, and all plants of its uncertainty box
        noack certify lane_following --weight chosen   with a norm that certifies more
        noack certify lane_weighted --late 6 --json   allow 6 steps of lateness
    """
    loaded, chosen = source.load(), None
    if weight == "chosen":
        with progress.work_bar("choosing the weight") as bar:
            result = certificates.certificates_of(loaded, weight, late, bar, of_model=True)
    else:
        result = certificates.certificates_of(loaded, weight, late, of_model=True)
    if weight == "given" and not result.schedule.exists:
        with progress.work_bar("no certificate in the given norm; choosing another") as bar:
            chosen = certificates.in_chosen_norm(loaded, result, bar)

    def to_json() -> dict[str, object]:
        return result.to_json() | {"in_chosen_norm": chosen and chosen.to_json()}

    cli.show(json, to_json, certificate_report.print_certificates, result, chosen)
    cli.write_tables(certificate_report.certificate_tables(result), tables, json=json)
    if out is not None:
        mat_export.save_mat(result.to_json(), out)
    certified = any(certificate.constants for _, certificate in result)
    return ExitStatus.OK if certified else ExitStatus.FAILED


@cli.command(
    cli.THEORY,
    30,
    takes="some seconds; minutes where the times of events vary, as with a deadline",
)
def margin(
    context: typer.Context,
    source: opt.OneLoopOptions,
    *,
    most: Annotated[int, Option(min=1, max=1000)] = 16,
    accuracy: float = 2e-4,
    period: bool = True,
    guarantee: Annotated[list[str] | None, Option("--guarantee", metavar="WORDS")] = None,
    effort: float = 1.0,
    play: Annotated[bool, Option("--play")] = False,
    runs: opt.RunsOption = DEFAULT_RUNS,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Find the largest M for which a loop is stable under every loss pattern.

    The trigger policy must have a longest time between two events, as periodic and deadline have.
    The verdict holds for all times of events that the policy allows. Exit status 1: the loop is not
    proven stable for any M.

    Options:
        most: Largest M to examine.
        accuracy: Wanted ratio of the bounds, minus 1; finer where they include 1.
        period: Search for the longest period with the scenario's own M, too.
        guarantee: Another guarantee to examine, e.g. "mansd 4 atmost 3 in 10"; can be repeated.
        effort: Factor of the work that a decision may take.
        play: Play the destabilising pattern in a live run.

    Examples:
        noack margin lane_periodic   the largest M and the longest period
        noack margin lane_periodic --play   play the destabilising pattern live
        noack margin lane_periodic --guarantee "atmost 5 in 9"   compare two guarantees
        noack margin lane_periodic --set mode=zoh --no-period --json   hold the input; as JSON
    """
    if play and json:
        raise CallerError("--play: has an output of its own; leave out --json")
    resolved = resolution.resolve(source.load())
    with cli.status("examining") as change:
        result = margin_search.find_margin(
            resolved,
            most_m=most,
            accuracy=accuracy,
            with_period=period,
            guarantees=guarantee or (),
            effort=effort,
            progress=lambda text: change(f"examining {text}"),
        )
    cli.show(json, result.to_json, certificate_report.print_margin, result)
    cli.write_tables(certificate_report.margin_tables(result), tables, json=json)
    if not play:
        return ExitStatus.OK if result.stable_m else ExitStatus.FAILED
    if (pattern := result.destabilised) is None:
        raise CallerError(f"--play: no destabilising pattern was found for M up to {most}")
    played = source.load(*pattern.settings)
    return run_processes(played, LiveOptions(runs=runs), server=context.obj)


@cli.command(cli.THEORY, 35, takes="a second")
def cost(
    source: opt.OneLoopOptions,
    *,
    weights: opt.CostOptions,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Compute the mean cost, and the rms of all states, under a scenario's random losses.

    The sensor is time-triggered (policy periodic). Means are over losses, disturbances and noise;
    nothing is sampled. The cost is integrated between the samples, too, with the losses' guarantee
    and without it. Exit status 1: with the guarantee, the second moments grow without a bound, or
    nothing is known. A horizon of more than 100,000 periods leaves only its own cost unknown.

    Examples:
        noack cost lane_periodic   growth, stationary rms, mean cost
        noack cost lane_periodic --R '[0.1, 0.1]' --json   with other weights; as JSON
        noack cost lane_periodic --set mansd=2   with a stricter guarantee
    """
    resolved = resolution.resolve(source.load())
    costs = mean_cost.find_mean_cost(resolved, *weights.matrices(resolved))
    cli.show(json, costs.to_json, certificate_report.print_mean_cost, costs)
    cli.write_tables(certificate_report.mean_cost_tables(costs), tables, json=json)
    guaranteed = costs.with_guarantee
    bounded = not isinstance(guaranteed, str) and not guaranteed.grows
    return ExitStatus.OK if bounded else ExitStatus.FAILED


class AdversaryAim(StrEnum):
    """What ``noack adversary`` may maximise."""

    ERROR = "error"
    STATE = "state"
    COST = "cost"
    INTER_EVENT = "inter-event"
    ALL = "all"


@cli.command(
    cli.THEORY,
    20,
    takes="some 20 s if all patterns can be tried; otherwise about as long for each objective",
)
def adversary(
    source: opt.OneLoopOptions,
    *,
    objective: AdversaryAim = AdversaryAim.ALL,
    horizon: float | None = None,
    nodes: Annotated[int, Option(min=0)] = 500_000,
    beam: Annotated[int, Option(min=0)] = 512,
    trigger: opt.TriggerOption = opt.TriggerMode.SAMPLED,
    json: opt.JsonOption = False,
) -> int:
    """Search for the worst losses that the network may cause; compare them with the bounds.

    The loop is that of the processes; with --trigger continuous it is the paper's, without delays.
    Exit status 1: a certified bound was exceeded.

    Options:
        objective: Maximise the controller's error ‖e_c‖, the state ‖x‖ or the cost ∫‖x‖² dt, or
            minimise the inter-event time.
        horizon: Seconds to search; the scenario's horizon by default.
        nodes: Limit of the exhaustive search for each objective, in segments between events (of
            some 0.3 s at 500 steps per second: about 25,000 per second); at the limit, the result
            of the beam search may be better.
        beam: Width of the beam search, in runs.

    Examples:
        noack adversary lane_following   all objectives
        noack adversary lane_following --objective error --json   the controller's error only
        noack adversary unstable_pendulum --horizon 2 --beam 64   a faster search
        noack adversary lane_following --trigger continuous   the paper's loop, in exact time
    """
    resolved = resolution.resolve(_with_horizon(source, horizon))
    continuous = trigger is opt.TriggerMode.CONTINUOUS
    if continuous:
        warn_of_left_out(resolved)
    conditions = adversary_search.conditions_of(resolved, continuous=continuous)
    certificate = scenario_certificates.certify(resolved, conditions)
    kinds, is_all = adversary_search.Objective, objective is AdversaryAim.ALL
    aims = list(kinds) if is_all else [kinds(objective.value)]
    with progress.search_activity() as report:
        worst_cases, stopped = _until_stopped(
            partial(
                adversary_search.find_worst,
                resolved,
                aim,
                continuous=continuous,
                most_nodes=nodes,
                beam=beam,
                certificate=certificate,
                report=report(aim.value),
            )
            for aim in aims
        )
    results = worst_cases, resolved, certificate, trigger.value
    cli.show(json, lambda: worst_run.document(*results), worst_run.print_worst, *results)
    if stopped is not None:
        missing = ", ".join(aim.value for aim in aims[len(worst_cases) :])
        print_to_stderr(f"noack: {stopped}; missing: {missing}")
        return stopped.exit_status
    return ExitStatus.FAILED if any(worst.breaches for worst in worst_cases) else ExitStatus.OK


def _with_horizon(source: opt.OneLoopOptions, horizon_s: float | None) -> "scenario.Scenario":
    """Return the scenario with another horizon; a message about it names the option that set it."""
    if horizon_s is None:
        return source.load()
    try:
        return source.load(f"horizon_s={horizon_s}")
    except CallerError as error:
        line = str(error).replace("--set horizon_s =", "--horizon")
        raise CallerError(line.replace("--set horizon_s", "--horizon")) from None


def _until_stopped(
    searches: "Iterable[Callable[[], worst_run.WorstRun]]",
) -> "tuple[list[worst_run.WorstRun], StopRequestError | None]":
    """Run searches; return the results until a signal came, and the signal.

    Raise StopRequestError if there is no result.
    """
    worst_cases: list[worst_run.WorstRun] = []
    try:
        for search in searches:
            worst = search()
            worst_cases.append(worst)
    except StopRequestError as stop:
        if not worst_cases:
            raise
        return worst_cases, stop
    return worst_cases, None
