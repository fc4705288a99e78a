"""``noack certify``, ``margin``, ``adversary``, ``cost``: all losses, bad ones, random ones."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from cosim.cli import options as opt
from cosim.cli.options import THEORY, examples
from cosim.cli.printing import show, status, status_of
from cosim.output.requirement import Requirement
from cosim.record.run_directory import DEFAULT_RUNS
from netem.core.command_line import StopRequestError, print_to_stderr
from netem.core.errors import CallerError, ExitStatus

if TYPE_CHECKING:
    from noack.scenario.scenario import Scenario
    from noack.theory.certificates.certified_bounds import ScenarioCertificate

app = typer.Typer()


@app.command(
    rich_help_panel=THEORY,
    epilog=examples(
        ("noack certify lane_following", "its plant, and all plants of its uncertainty box"),
        ("noack certify lane_following --verbose", "every bound, setting and assumption"),
        ("noack certify lane_weighted --late 6 --json", "allow 6 steps of lateness"),
        ("noack certify lane_following --document loop.json --proof proof.json", "for noack-check"),
        ("noack certify lane_following --document loop.json --proof proof.json", "as two files"),
        ("noack certify lane_following --require certificate", "exit status 1 if there is none"),
    ),
)
def certify(
    scenario: opt.ScenarioArgument,
    settings: opt.SetOption = None,
    network: opt.NetworkOption = None,
    loop: opt.LoopOption = None,
    late: Annotated[
        int | None,
        Option(
            help="Allowed lateness in steps of the plant, 0 to 1000; certificate.late_periods by default.",
        ),
    ] = None,
    require: Annotated[
        list[Requirement] | None,
        Option(
            "--require",
            help="Exit with status 1, and one line that says why, unless: certificate: the plant has "
            "one for the scenario's schedule; guarantee: the network also enforces the limit of the "
            "losses; stable: ‖x‖ is proven to have a bound. Can be repeated.",
        ),
    ] = None,
    tables: opt.TablesOption = None,
    out: Annotated[
        Path | None,
        Option(
            callback=opt.usable_path,
            help="Write the certificates for MATLAB and Octave (.mat).",
        ),
    ] = None,
    equations: Annotated[
        Path | None,
        Option(
            callback=opt.usable_path,
            help="Write the plant's equations that the document is about to this file, for noack-check "
            "--equations.",
        ),
    ] = None,
    document: Annotated[
        Path | None,
        Option(
            callback=opt.usable_path,
            help="Write the loop document, which the bounds are proven of, to this file (.json) for "
            "noack-check; `noack check NAME --document` prints it in words.",
        ),
    ] = None,
    proof: Annotated[
        Path | None,
        Option(
            callback=opt.usable_path,
            help="Write the proof of the document's bounds to this file (.json), for noack-check. If some "
            "bounds are smaller by small gains, a second pair of files has these: FILE.gains.json.",
        ),
    ] = None,
    search: Annotated[
        bool,
        Option(
            help="Search for the smallest bounds that can be proven, for seconds, at most some minutes; else "
            "those that need no search, in seconds."
        ),
    ] = True,
    verbose: Annotated[
        bool, Option("--verbose", help="Print every bound, the largest settings and the assumptions.")
    ] = False,
    paper: Annotated[
        bool,
        Option(
            "--paper",
            help="Print the paper's assumptions and statements, which are about a continuous trigger.",
        ),
    ] = False,
    json: opt.JsonOption = False,
) -> int:
    """Prove the bounds that are guaranteed for a scenario, and print their conditions.

    Exit status 1: nothing can be proven, not even under the paper's conditions; or --require is not met.

    Each bound was verified by noack-check. What is found is kept in the cache folder of the user.
    """
    from cosim.analysis.certificates import certificates_of
    from cosim.analysis.loop_files import files_of_widest, gains_of_widest
    from cosim.live.monitoring.progress import work_bar
    from cosim.output.certificate_report import certificate_document
    from cosim.output.export.mat_export import save_mat
    from cosim.output.requirements import uncovered_as_unmet, unmet_by_scenario
    from cosim.record.run_directory import write_output
    from netem.core.file_access import require_suffix
    from noack.scenario.resolution import resolve
    from noack.theory.witnesses.effort import MOST_WORK

    if out is not None:
        require_suffix(out, "--out", ".mat")
    if equations is not None and document is None:
        raise CallerError("--equations: they belong to a document; add --document FILE and --proof FILE")
    if (document is None) != (proof is None):
        raise CallerError("--document and --proof: noack-check needs both files; add the other option")
    loaded = opt.load_loop(scenario, settings, loop, network)
    if equations is not None and resolve(loaded).coverage.is_linear:
        raise CallerError("--equations: the plant is linear; its statements need no file of equations")
    with uncovered_as_unmet(require or ()):
        result = certificates_of(loaded, late)
    with work_bar("finding and verifying proofs" if search else "verifying proofs", lines=True) as bar:
        witnesses = result.prove(bar, MOST_WORK if search else 0.0)
    if document is not None and proof is not None:
        files = files_of_widest(result.scenario, witnesses)
        files.verify()
        write_output(document, files.document)
        write_output(proof, files.proof)
        command = f"noack-check {document} {proof}{'' if equations is None else f' --equations {equations}'}"
        print_to_stderr(f"noack: wrote {document} and {proof}; {command} verifies them")
        if (more := gains_of_widest(result.scenario, witnesses)) is not None:
            more.verify()
            pair = [path.with_suffix(f".gains{path.suffix}") for path in (document, proof)]
            for path, content in zip(pair, (more.document, more.proof), strict=True):
                write_output(path, content)
            print_to_stderr(
                f"noack: wrote {pair[0]} and {pair[1]}, of bounds by small gains; "
                f"noack-check {pair[0]} {pair[1]} verifies them"
            )
    if equations is not None and witnesses.are_any:
        write_output(equations, witnesses.equations_text())
        print_to_stderr(f"noack: wrote {equations}; compare it with the plant's code")
    if search:
        with work_bar("trying smaller thresholds", lines=True) as bar:
            result.advise(bar)
    page = certificate_document(result, verbose=verbose or tables is not None, paper=paper)
    show(page, json=json, tables=tables)
    if out is not None:
        save_mat(result.to_json(), out)
    if require:
        return status_of(unmet_by_scenario(result, require))
    is_proven = result.is_proven_stable or any(certificate.exists for _, certificate in result)
    return ExitStatus.OK if is_proven else ExitStatus.FAILED


class AdversaryAim(StrEnum):
    """What ``noack adversary`` may maximise."""

    ERROR = "error"
    STATE = "state"
    COST = "cost"
    INTER_EVENT = "inter-event"
    ALL = "all"


@app.command(
    rich_help_panel=THEORY,
    epilog=examples(
        ("noack adversary lane_following", "all objectives"),
        ("noack adversary lane_following --objective error --json", "the controller's error only"),
        ("noack adversary unstable_pendulum --horizon 2 --beam 64", "a faster search"),
    ),
)
def adversary(
    scenario: opt.ScenarioArgument,
    settings: opt.SetOption = None,
    network: opt.NetworkOption = None,
    loop: opt.LoopOption = None,
    objective: Annotated[
        AdversaryAim,
        Option(
            help="Maximise the controller's error ‖e_c‖, the state ‖x‖ or the cost ∫‖x‖² dt, or "
            "minimise the inter-event time."
        ),
    ] = AdversaryAim.ALL,
    horizon: Annotated[
        float | None, Option(help="Seconds to search; the scenario's horizon by default.")
    ] = None,
    nodes: Annotated[
        int,
        Option(
            min=0,
            help="Limit of the exhaustive search for each objective, in times between events (of "
            "some 0.3 s at 500 steps per second: about 25,000 per second); at the limit, the result "
            "of the beam search may be better.",
        ),
    ] = 500_000,
    beam: Annotated[int, Option(min=0, help="Width of the beam search, in runs.")] = 512,
    json: opt.JsonOption = False,
) -> int:
    """Search for the worst losses that the network may cause; compare them with the bounds.

    Exit status 1: a certified bound was exceeded.

    Takes some 20 s if all patterns can be tried, and some minutes otherwise. Of a plant that is not given by
    matrices, some hundred patterns are simulated.
    """
    from cosim.analysis import adversary as adversary_search
    from cosim.analysis.adversary.worst_run import BREACH, WorstRun
    from cosim.live.monitoring.progress import search_activity
    from cosim.output.adversary_report import adversary_document
    from cosim.simulation.sampled_loop import SampledLoop
    from noack.scenario.resolution import resolve

    try:
        within = [] if horizon is None else [f"horizon_s={horizon}"]
        resolved = resolve(opt.load_loop(scenario, [*(settings or ()), *within], loop, network))
    except CallerError as error:  # a message about the horizon names the option that set it
        if horizon is None:
            raise
        line = str(error).replace("--set horizon_s =", "--horizon")
        raise CallerError(line.replace("--set horizon_s", "--horizon")) from None
    by_runs = not resolved.coverage.is_linear
    if not by_runs:
        SampledLoop(resolved)  # refuses what cannot be searched
    certificate = _certificate_to_compare(resolved)
    if by_runs and not certificate.exists:
        print_to_stderr(f"noack: no certificate, which a plant by equations needs: {certificate.void}")
        return ExitStatus.FAILED
    kinds, is_all = adversary_search.Objective, objective is AdversaryAim.ALL
    aims = list(kinds) if is_all else [kinds(objective.value)]
    worst_cases: list[WorstRun] = []
    shares: dict[str, float] = {}
    stopped: StopRequestError | None = None
    try:
        with search_activity() as report:
            if by_runs:
                worst_cases, shares = adversary_search.find_worst_by_runs(
                    resolved, aims, certificate, report=report("losses")
                )
            for aim in () if by_runs else aims:
                worst = adversary_search.find_worst(
                    resolved,
                    aim,
                    most_nodes=nodes,
                    beam=beam,
                    certificate=certificate,
                    report=report(aim.value),
                )
                worst_cases.append(worst)
    except StopRequestError as stop:  # the results so far are shown
        if not worst_cases:
            raise
        stopped = stop
    show(adversary_document(worst_cases, resolved, certificate, shares), json=json)
    if stopped is not None:
        missing = ", ".join(aim.value for aim in aims[len(worst_cases) :])
        print_to_stderr(f"noack: {stopped}; missing: {missing}")
        return stopped.exit_status
    is_exceeded = any(worst.breaches for worst in worst_cases) or max(shares.values(), default=0.0) > BREACH
    return ExitStatus.FAILED if is_exceeded else ExitStatus.OK


def _certificate_to_compare(resolved: "Scenario") -> "ScenarioCertificate":
    """Return the certificate of the scenario's own plant, as ``noack certify`` proves it."""
    from cosim.analysis.certificates import Certificates
    from cosim.analysis.witnesses import plants_of
    from cosim.live.monitoring.progress import work_bar

    results = Certificates(resolved)
    with work_bar("searching for proofs", lines=True) as bar:
        results.prove(bar, conditions=("schedule",), plants=plants_of(resolved)[:1])
    return results.schedule


@app.command(
    rich_help_panel=THEORY,
    epilog=examples(
        ("noack margin lane_periodic", "how many lost in a row, and the longest period"),
        ("noack margin lane_periodic --play", "play the destabilising pattern live"),
        ('noack margin lane_periodic --guarantee "atmost 5 in 9"', "compare two guarantees"),
        ("noack margin lane_periodic --set mode=zoh --no-period --json", "hold the input; as JSON"),
    ),
)
def margin(
    scenario: opt.ScenarioArgument,
    settings: opt.SetOption = None,
    network: opt.NetworkOption = None,
    loop: opt.LoopOption = None,
    most: Annotated[int, Option(help="Largest number of losses in a row to examine, 0 to 999.")] = 15,
    accuracy: Annotated[
        float, Option(help="Wanted ratio of the bounds, minus 1; finer where they include 1.")
    ] = 4e-3,
    period: Annotated[
        bool, Option(help="Search for the longest period with the scenario's own guarantee, too.")
    ] = True,
    guarantee: Annotated[
        list[str] | None,
        Option(
            metavar="WORDS",
            help='Another guarantee to examine, e.g. "mansd 4 atmost 3 in 10"; can be repeated.',
        ),
    ] = None,
    effort: Annotated[float, Option(help="Factor of the work that a decision may take.")] = 1.0,
    play: Annotated[bool, Option("--play", help="Play the destabilising pattern in a live run.")] = False,
    document: Annotated[
        Path | None,
        Option(
            callback=opt.usable_path,
            help="Write the loop document that the proofs are about to this file (.json), for noack-check.",
        ),
    ] = None,
    proof: Annotated[
        Path | None,
        Option(callback=opt.usable_path, help="Write the proof to this file (.json), for noack-check."),
    ] = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Find how many packets may be lost in a row while a loop is stable under every loss pattern.

    The trigger policy must have a longest time between two events, as periodic and deadline have.
    The verdict holds for all times of events that the policy allows. Exit status 1: the loop is not
    proven stable even without losses.

    --play takes the scenario's horizon, or a longer one, up to 10 minutes, at which the growth of
    ‖x‖ shows, and prints what to expect.

    Takes a second of CPU time for each number of losses, and minutes if the times of events vary, as with a
    deadline. The search for the longest period adds some seconds. Each result is printed when it is known.
    """
    from cosim.analysis.margin_search import find_margin
    from cosim.output.certificate_report import margin_document
    from cosim.record.run_directory import write_output
    from noack.scenario.resolution import resolve

    if (document is None) != (proof is None):
        raise CallerError("--document and --proof: noack-check needs both files; add the other option")
    if play and json:
        raise CallerError("--play: has an output of its own; leave out --json")
    if play:
        opt.require_linux()
    stops: list[StopRequestError] = []
    with status("examining") as change:
        result = find_margin(
            resolve(opt.load_loop(scenario, settings, loop, network)),
            on_stop=stops.append,
            most_mansd=most,
            accuracy=accuracy,
            with_period=period,
            guarantees=guarantee or (),
            effort=effort,
            progress=lambda text: change(f"examining {text}"),
            decided=lambda cap: print_to_stderr(f"noack: {cap.text}"),
        )
    show(margin_document(result), json=json, tables=tables)
    if document is not None and proof is not None and result.proof is not None:
        write_output(document, result.proof.document)
        write_output(proof, result.proof.proof)
        print_to_stderr(f"noack: wrote {document} and {proof}; noack-check {document} {proof} verifies them")
    elif document is not None:
        raise CallerError("--document: nothing was proven of this loop by a document")
    if stops:  # the results so far are shown
        print_to_stderr(f"noack: {stops[0]}; missing: {', '.join(result.missing)}")
        return stops[0].exit_status
    if not play:
        return ExitStatus.OK if result.stable_mansd is not None else ExitStatus.FAILED
    if (pattern := result.destabilised) is None:
        raise CallerError(f"--play: no destabilising pattern was found with up to {most} lost in a row")
    if result.ties:
        raise CallerError(f"--play: no run can choose the ticks of the pattern: {result.ties}")
    from cosim.cli.destabilising_run import until_it_shows
    from cosim.cli.execute_run import run_processes

    with status("trying how long the pattern must be played until its growth shows"):
        played = until_it_shows(
            opt.load_loop(scenario, [*(settings or ()), *pattern.settings], loop, network)
        )
    print(played.expected, flush=True)
    return run_processes(played.scenario, runs)


@app.command(
    rich_help_panel=THEORY,
    epilog=examples(
        ("noack cost lane_periodic", "growth, stationary rms, mean cost"),
        ("noack cost lane_periodic --R '[0.1, 0.1]' --json", "with other weights; as JSON"),
        ("noack cost lane_periodic --set mansd=2", "with a stricter guarantee"),
    ),
)
def cost(
    scenario: opt.ScenarioArgument,
    settings: opt.SetOption = None,
    network: opt.NetworkOption = None,
    loop: opt.LoopOption = None,
    Q: opt.StateWeightOption = None,
    R: opt.InputWeightOption = None,
    tables: opt.TablesOption = None,
    json: opt.JsonOption = False,
) -> int:
    """Compute the mean cost, and the rms of all states, under a scenario's random losses.

    The sensor is time-triggered (policy periodic). Means are over losses, disturbances and noise;
    nothing is sampled. The cost is integrated between the samples, too, with the losses' guarantee
    and without it. Exit status 1: with the guarantee, the second moments grow without a bound, or
    nothing is known. A horizon of more than 100,000 periods leaves only its own cost unknown.

    Takes a second.
    """
    from cosim.analysis.mean_cost import find_mean_cost
    from cosim.cli.cost_weights import given_weight
    from cosim.output.certificate_report import mean_cost_document
    from noack.scenario.arrival_ties import late_inputs, with_later_updates
    from noack.scenario.resolution import resolve

    settled, tie = with_later_updates(opt.load_loop(scenario, settings, loop, network))
    for line in filter(None, (tie, late_inputs(settled))):
        print_to_stderr(f"noack: {line}")
    resolved = resolve(settled)
    costs = find_mean_cost(resolved, given_weight(Q), given_weight(R))
    show(mean_cost_document(costs), json=json, tables=tables)
    guaranteed = costs.with_guarantee
    bounded = not isinstance(guaranteed, str) and not guaranteed.grows
    return ExitStatus.OK if bounded else ExitStatus.FAILED
