"""Commands on what is claimed: certificates, the worst losses, the paper reproduced."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from cosim.cli.command import (
    THEORY,
    JsonOption,
    ScenarioArgument,
    SetOption,
    command,
    cores,
    find_scenario,
    print_json,
)
from cosim.record.run_directory import DEFAULT_RUNS
from noack.config.scenario_file import load
from noack.core.errors import ExitStatus


@command(THEORY, [
    ("noack certify lane_following", "its plant and its uncertainty box"),
    ("noack certify lane_following --weight chosen", "in a norm that certifies more"),
    ("noack certify lane_weighted --late 6 --json", "a schedule that may be 6 steps late"),
])  # fmt: skip
def certify(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    weight: Annotated[
        str,
        typer.Option(
            help="The trigger's norm: `given` by the scenario, `identity`, or `chosen` here."
        ),
    ] = "given",
    late: Annotated[
        int | None,
        typer.Option(help="Steps of the plant by which the schedule may be late.", min=0, max=1000),
    ] = None,
    json: JsonOption = False,
) -> int:
    """Say what is guaranteed of a scenario, with which constants, under which conditions."""
    from cosim.live.progress import work_bar
    from cosim.output.certificate_report import print_study, study_scenario

    loaded = load(find_scenario(scenario), settings or ())
    with work_bar("choosing the weight") as progress:
        found = study_scenario(loaded, weight, late, progress)
    if json:
        print_json(found.to_json())
    else:
        print_study(Console(), found)
    certified = any(certificate.constants for _, certificate in found.certificates)
    return ExitStatus.OK if certified else ExitStatus.FAILED


class AdversaryAim(StrEnum):
    """What ``noack adversary`` may look for."""

    ERROR = "error"
    STATE = "state"
    COST = "cost"
    INTER_EVENT = "inter-event"
    ALL = "all"


@command(THEORY, [
    ("noack adversary lane_following", "all objectives"),
    ("noack adversary lane_following --objective error --json", "the controller's error"),
    ("noack adversary unstable_pendulum --horizon 2 --beam 64", "a quicker search"),
])  # fmt: skip
def adversary(
    scenario: ScenarioArgument,
    objective: Annotated[
        AdversaryAim,
        typer.Option(
            help="What is to be as bad as possible: the controller's error, the state, "
            "the integral of its square, or the time between two events."
        ),
    ] = AdversaryAim.ALL,
    horizon: Annotated[
        float | None, typer.Option(help="Seconds to look ahead; the scenario's unless given.")
    ] = None,
    nodes: Annotated[
        int, typer.Option(help="Try all patterns, up to so many segments between events.", min=0)
    ] = 500_000,
    beam: Annotated[
        int, typer.Option(help="Runs that the beam search carries along.", min=0)
    ] = 512,
    settings: SetOption = None,
    json: JsonOption = False,
) -> int:
    """Search the losses that the network may make for the worst, and how near bounds come to it."""
    from cosim.analysis.adversary import Objective, find_worst
    from cosim.analysis.adversary.adversary_report import document, print_worst
    from cosim.live.progress import search_status
    from noack.config.resolution import resolve
    from noack.theory.run_conditions import ideal_conditions
    from noack.theory.scenario_certificates import certify

    given = [] if horizon is None else [f"horizon_s={horizon}"]
    resolved = resolve(load(find_scenario(scenario), [*(settings or ()), *given]))
    certificate = certify(resolved, ideal_conditions(resolved))
    aims = list(Objective) if objective is AdversaryAim.ALL else [Objective(objective.value)]
    with search_status() as report:
        found = [
            find_worst(
                resolved, aim, most_nodes=nodes, beam=beam, certificate=certificate,
                report=report(aim.value),
            )
            for aim in aims
        ]  # fmt: skip
    if json:
        print_json(document(found, resolved, certificate))
    else:
        print_worst(Console(), found, resolved, certificate)
    refuted = any(worst.breaches for worst in found)
    return ExitStatus.FAILED if refuted else ExitStatus.OK


@command(THEORY, [
    ("noack paper", "1,000 draws, some minutes; into runs/paper"),
    ("noack paper --draws 50 --out paper --json", "fewer draws, as JSON"),
])  # fmt: skip
def paper(
    draws: Annotated[int, typer.Option(help="Draws of plant, losses and initial state.")] = 1000,
    out: Annotated[
        Path, typer.Option("--out", help="Folder for paper.md, and for figures/ in it.")
    ] = DEFAULT_RUNS / "paper",
    json: JsonOption = False,
) -> int:
    """Reproduce the paper's Section V over many draws: a page with figures, tables and verdicts."""
    from cosim.live.progress import PatientConsole, draws_bar
    from cosim.studies.paper.paper_run import document, make_folder, reproduce, write_page
    from cosim.studies.paper.paper_table import print_claims

    make_folder(out)
    with draws_bar(PatientConsole(stderr=True)) as progress:
        results = reproduce(draws, cores(), progress)
    found = document(results, write_page(results, out))
    if json:
        print_json(found)
    else:
        print_claims(Console(), found)
    return ExitStatus.OK
