"""``noack doctor``: this machine; ``linearise``, ``gain``, ``new``, ``scenarios``, ``check``, ``schema``.

The other six are about scenario files. The first three of them lead from a plant to a scenario.
"""

import json as json_format
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer
from typer import Argument, Option

from cosim.cli import options as opt
from cosim.cli.options import FILES, examples
from cosim.cli.printing import console, print_json, print_lines, status
from cosim.record.run_directory import DEFAULT_RUNS
from cosim.shipped_files import KINDS, ShippedFile, all_shipped, text_of
from noack.core.errors import CallerError, ExitStatus

if TYPE_CHECKING:
    from cosim.studies.new_loop.linear_model import LinearModel, LoopGain
    from noack.settings.section import Table

app = typer.Typer()

Number = TypeVar("Number", float, complex)
PlantArgument = Annotated[
    str,
    Argument(
        metavar="PLANT",
        help="FILE.py:Class, a kind of plant such as cart_pole, a scenario, or a file that "
        "linearise or gain wrote.",
    ),
]


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack doctor", "for the paper's example"),
        ("noack doctor lane_weighted --set speed=4", "for another scenario"),
        ("noack doctor --seconds 10 --json", "measure longer; all numbers as JSON"),
    ),
)
def doctor(
    scenario: opt.ScenarioArgument = "lane_following",
    settings: opt.SetOption = None,
    seconds: Annotated[
        float,
        Option(
            min=0.1,
            max=3600,
            help="Seconds of each measurement of wake-ups: without and with real-time settings.",
        ),
    ] = 2.0,
    runs: opt.RunsOption = DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Check this machine: real-time settings, timers, ports, disk.

    Each finding is good, limited or bad, with its meaning for a run and a remedy. The scenario
    determines rates, ports and the allowed lateness.

    Exit status 1: a finding is bad, so that no run is possible.

    Takes some 10 s.
    """
    opt.require_linux()
    from cosim.doctor import findings
    from cosim.doctor.machine_measures import measure, requirements_of
    from noack.scenario.resolution import resolve

    resolved = resolve(opt.load_scenario(scenario, settings))
    required = requirements_of(resolved)
    with status("measuring"):
        machine = measure(resolved, required, runs, seconds)
    results = findings.find_all(machine, required)
    if json:
        print_json(findings.document(machine, required, results))
    else:
        findings.print_findings(console(), required, results)
    is_bad = findings.worst(results) is findings.MachineVerdict.BAD
    return ExitStatus.FAILED if is_bad else ExitStatus.OK


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack linearise cart_pole", "a plant that comes with noack"),
        ("noack linearise pole.py:Pole --out pole.json", "a class of yours; write the model"),
        ("noack linearise four_tank --set plant.system.voltages_v=[4.0,4.0] --json", "as JSON"),
    ),
)
def linearise(
    plant: PlantArgument,
    settings: opt.SetOption = None,
    at: Annotated[str | None, Option(help="x at the point, e.g. 0,0,0.1,0; by default 0.")] = None,
    operating_input: Annotated[str | None, Option("--input", help="u at the point; by default 0.")] = None,
    within: Annotated[
        float, Option(help="Half-width of the neighbourhood in which the error is sampled.")
    ] = 0.1,
    out: Annotated[
        Path | None,
        Option(callback=opt.usable_path, help="Write the model as JSON, for gain and new."),
    ] = None,
    json: opt.JsonOption = False,
) -> None:
    """Print the linear model of a plant, its error, its eigenvalues and its controllable part.

    A plant with a derivative is differentiated; another one is moved, and the matrix logarithm of a
    step is taken. This runs the code of a plant in Python.

    Takes about a second.
    """
    from cosim.studies.new_loop.linear_model import linearise as linearise_plant

    model = linearise_plant(
        plant,
        at=_numbers("--at", at),
        input=_numbers("--input", operating_input),
        settings=_table(settings),
        within=within,
    )
    _show_model(model, out, json=json)


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack gain cart_pole --q 10,1,10,1 --r 0.1", "a regulator for these weights"),
        ("noack gain pole.json --out pole.json", "add a gain to a model that linearise wrote"),
        ("noack gain cart_pole --poles=-2,-3,-4,-5 --json", "given poles, as JSON"),
    ),
)
def gain(
    plant: PlantArgument,
    settings: opt.SetOption = None,
    q: Annotated[
        str | None,
        Option(
            "--q",
            help="Weight of the states in ∫ xᵀQx + uᵀRu dt: a number, or the diagonal, e.g. "
            "10,1,10,1; by default 1.",
        ),
    ] = None,
    r: Annotated[str | None, Option("--r", help="Weight of the inputs, likewise.")] = None,
    poles: Annotated[
        str | None,
        Option(help="Eigenvalues of Â + B̂K instead, e.g. --poles=-1,-2,-3+1j,-3-1j."),
    ] = None,
    out: Annotated[
        Path | None,
        Option(callback=opt.usable_path, help="Write the model and the gain as JSON, for new."),
    ] = None,
    json: opt.JsonOption = False,
) -> None:
    """Compute the gain K of u = K x: a linear-quadratic regulator, or given closed-loop poles.

    Takes about a second.
    """
    from cosim.studies.new_loop.linear_model import gain as gain_of_plant

    result = gain_of_plant(
        plant,
        q=_numbers("--q", q),
        r=_numbers("--r", r),
        poles=_numbers("--poles", poles, complex),
        settings=_table(settings),
    )
    _show_model(result, out, json=json)


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack new pole.toml --plant pole.py:Pole", "everything from a class of yours"),
        ("noack new pole.toml --plant pole.json", "from the file of linearise or gain"),
        ("noack new tanks.toml --plant four_tank --set network.mansd=2", "keep a setting"),
    ),
)
def new(
    file: Annotated[Path, Argument(metavar="FILE.toml", help="The scenario file to write.")],
    plant: Annotated[str, Option("--plant", metavar="PLANT", help="As for linearise.")],
    settings: opt.SetOption = None,
    x0: Annotated[
        str | None,
        Option("--x0", help="The initial state x(0), e.g. 0.1,0,0.1,0; by default chosen."),
    ] = None,
    json: opt.JsonOption = False,
) -> None:
    """Write a complete scenario for a plant, with comments, and settings that are certified.

    The gain is chosen, too, unless the plant is a file that gain wrote. Choose it by weights or
    poles there: `noack gain PLANT --q 10,1 --r 0.1 --out pole.json`. If no certificate is found,
    the scenario is written all the same, with the reason. --set fixes settings.

    Takes some 10 s.
    """
    from cosim.studies.new_loop.new_scenario import new as new_scenario

    if file.suffix != ".toml":
        raise CallerError(f"{file}: the name of a scenario file ends in .toml")
    if file.exists():
        raise CallerError(f"{file}: exists; give another name, or remove it first")
    if not file.parent.is_dir():
        raise CallerError(f"{file}: there is no folder {file.parent}")
    with status("linearising") as change:
        result = new_scenario(
            plant,
            file,
            initial_state=_numbers("--x0", x0),
            settings=_table(settings),
            report=change,
        )
    result.save(file)
    following = f"wrote {file}; now noack check, certify, simulate or run {file}"
    print_lines(json, result.to_json(), *result.notes, following)


def _table(assignments: Sequence[str] | None) -> "Table":
    """Return the values of --set by their keys."""
    from noack.scenario.scenario_file import setting_of

    return dict(setting_of(assignment, "plant.system.cart_kg=1.0") for assignment in assignments or ())


def _numbers(option: str, text: str | None, kind: Callable[[str], Number] = float) -> list[Number] | None:
    if text is None:
        return None
    try:
        return [kind(word) for word in text.replace(" ", "").strip("[]()").split(",")]
    except ValueError:
        raise CallerError(f"{option} {text}: give numbers with commas, e.g. -1,-0.5") from None


def _show_model(result: "LinearModel | LoopGain", out: Path | None, *, json: bool) -> None:
    """Print a result, and write its document, not over that of another plant."""
    from cosim.studies.new_loop.linear_model import read_document
    from noack.core.file_access import write_whole

    if out is not None:
        if out.suffix != ".json":
            raise CallerError(f"--out {out}: the name of a model ends in .json")
        label = result.to_json()["plant"]
        if out.exists() and (other_plant := read_document(out)["plant"]) != label:
            raise CallerError(f"--out {out}: has the model of {other_plant}; give another name")
        write_whole(out, json_format.dumps(result.to_json(), indent=2))
    print_lines(json, result.to_json(), repr(result))


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack scenarios", "list them all"),
        ("noack scenarios unstable_pendulum > mine.toml", "copy one, to make it your own"),
        ("noack scenarios --json", "list them as JSON"),
    ),
)
def scenarios(
    name: Annotated[
        str | None,
        Argument(autocompletion=opt.complete_shipped, help="Print this scenario or campaign."),
    ] = None,
    json: opt.JsonOption = False,
) -> None:
    """List the shipped scenarios and campaigns, or print one of them."""
    if name is not None:
        text = text_of(name)
        print_json({"name": name, "toml": text}) if json else print(text, end="")
        return
    shipped = {kind: all_shipped(kind) for kind in KINDS}
    if json:
        print_json(
            {
                kind: [file._asdict() | {"path": str(file.path)} for file in files]
                for kind, files in shipped.items()
            }
        )
        return
    for kind, files in shipped.items():
        console().print(kind, style="bold", highlight=False)
        _print_shipped(files)


def _print_shipped(files: Sequence[ShippedFile]) -> None:
    """Print one line per file to a pipe, or a wrapped table to a terminal."""
    from rich.table import Table

    width = max(len(file.name) for file in files)
    if not console().is_terminal:
        for file in files:
            print(f"{file.name:{width}}  {file.description}")
        return
    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=width, no_wrap=True, style="cyan")
    table.add_column()
    for file in files:
        table.add_row(file.name, file.description)
    console().print(table)


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack check lane_following", "print the scenario and its assumptions"),
        ("noack check lane_following --set mode=zoh --json", "as JSON"),
    ),
)
def check(
    scenario: opt.ScenarioArgument, settings: opt.SetOption = None, json: opt.JsonOption = False
) -> None:
    """Check a scenario and print it with all defaults and random draws filled in.

    The output is a scenario file. Comments at its end say which of the paper's assumptions hold.

    A nonlinear plant is also started and linearised. For a plant in Python this runs its code.
    """
    from cosim.cli.scenario_check import check_scenario

    check_scenario(opt.load_scenario(scenario, settings), json=json)


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack schema > scenario.schema.json", "for an editor that completes keys"),
        ("noack schema --campaign", "the schema of campaign files"),
        ("noack schema --netem", "the schema of the emulator's links files"),
    ),
)
def schema(
    netem: Annotated[bool, Option("--netem", help="Print the schema of the emulator's links files.")] = False,
    campaign: Annotated[bool, Option("--campaign", help="Print the schema of campaign files.")] = False,
    json: opt.JsonOption = False,
) -> None:
    """Print the JSON Schema of scenario files, for editors."""
    if campaign:
        from cosim.studies.campaign.campaign_file import json_schema as campaign_schema

        print_json(campaign_schema())
    elif netem:
        from netem.links_file import json_schema as links_schema

        print_json(links_schema())
    else:
        from noack.scenario.scenario import Scenario
        from noack.scenario.toml_file import json_schema

        print_json(json_schema(Scenario))
