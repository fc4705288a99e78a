"""``noack doctor``: this machine; ``scenarios``, ``check``, ``schema``, ``linearise``, ``gain``, ``new``.

The other six are about scenario files. The last three lead from a plant to a scenario.
"""

import json as json_format
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

from typer import Argument, Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.lazy_modules import lazy_modules
from cosim.record.run_directory import DEFAULT_RUNS
from cosim.shipped_files import KINDS, ShippedFile, all_shipped, text_of
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError, ExitStatus
from noack.core.file_access import write_whole

with lazy_modules():
    from controller_node import controller
    from cosim.analysis.summary import plant_linearisation
    from cosim.doctor import findings, machine_measures
    from cosim.live import launcher
    from cosim.output import terminal_output
    from cosim.studies.campaign import campaign_file
    from cosim.studies.new_loop import linear_model, new_scenario
    from netem import links_file
    from noack.scenario import resolution, scenario, scenario_file, toml_file
    from noack.theory.certificates import assumptions
    from noack.trigger_policies import periodic_trigger, trigger_rule
    from plant_server import plant

if TYPE_CHECKING:
    from rich.console import Console

    from noack.settings.section import Table

_COMMENT = "# "
Number = TypeVar("Number", float, complex)
PlantArgument = Annotated[
    str,
    Argument(
        metavar="PLANT",
        help="FILE.py:Class, FILE.fmu, gymnasium:ID, a kind of plant such as cart_pole, a "
        "scenario, or a file that linearise or gain wrote.",
    ),
]


@cli.command(cli.FILES, 10, takes="some 10 s", on_linux=True)
def doctor(
    source: opt.ExampleOptions,
    *,
    seconds: Annotated[float, Option(min=0.1, max=3600)] = 2.0,
    runs: opt.RunsOption = DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Check this machine: real-time settings, timers, ports, disk.

    Each finding is good, limited or bad, with its meaning for a run and a remedy. The scenario
    determines rates, ports and the allowed lateness.

    Exit status 1: a finding is bad, so that no run is possible.

    Options:
        seconds: Seconds of each measurement of wake-ups: without and with real-time settings.

    Examples:
        noack doctor   for the paper's example
        noack doctor lane_weighted --set speed=4   for another scenario
        noack doctor --seconds 10 --json   measure longer; all numbers as JSON
    """
    resolved = resolution.resolve(source.load())
    required = machine_measures.requirements_of(resolved)
    with cli.status("measuring"):
        machine = machine_measures.measure(resolved, required, runs, seconds)
    results = findings.find_all(machine, required)
    cli.show(
        json,
        lambda: findings.document(machine, required, results),
        findings.print_findings,
        required,
        results,
    )
    is_bad = findings.worst(results) is findings.MachineVerdict.BAD
    return ExitStatus.FAILED if is_bad else ExitStatus.OK


@cli.command(cli.FILES, 20)
def scenarios(
    name: Annotated[str | None, Argument(autocompletion=opt.complete_shipped)] = None,
    *,
    json: opt.JsonOption = False,
) -> None:
    """List the shipped scenarios and campaigns, or print one of them.

    Options:
        name: Print this scenario or campaign.

    Examples:
        noack scenarios   list them all
        noack scenarios unstable_pendulum > mine.toml   copy one, to make it your own
        noack scenarios --json   list them as JSON
    """
    if name is not None:
        text = text_of(name)
        cli.print_json({"name": name, "toml": text}) if json else print(text, end="")
        return
    shipped = {kind: all_shipped(kind) for kind in KINDS}
    if json:
        cli.print_json(
            {
                kind: [file._asdict() | {"path": str(file.path)} for file in files]
                for kind, files in shipped.items()
            }
        )
        return
    console = cli.console()
    for kind, files in shipped.items():
        console.print(kind, style="bold", highlight=False)
        _print_shipped(console, files)


def _print_shipped(console: "Console", files: Sequence[ShippedFile]) -> None:
    """Print one line per file to a pipe, or a wrapped table to a terminal."""
    width = max(len(file.name) for file in files)
    if not console.is_terminal:
        for file in files:
            print(f"{file.name:{width}}  {file.description}")
        return
    from rich.table import Table  # a pipe needs none

    table = Table.grid(padding=(0, 2))
    table.add_column(min_width=width, no_wrap=True, style="cyan")
    table.add_column()
    for file in files:
        table.add_row(file.name, file.description)
    console.print(table)


@cli.command(cli.FILES, 30)
def check(source: opt.ScenarioOptions, *, json: opt.JsonOption = False) -> None:
    """Check a scenario and print it with all defaults and random draws filled in.

    The output is a scenario file. Comments at its end say which of the paper's assumptions hold.

    A nonlinear plant is also started and linearised. For a plant in Python this runs its code.

    Examples:
        noack check lane_following   print the scenario and its assumptions
        noack check lane_following --set mode=zoh --json   as JSON
    """
    loaded = source.load()
    if len(scenario.loop_names(loaded)) > 1:
        _check_loops(loaded, json=json)
        return
    resolved = resolution.resolve(loaded)
    _make_trigger(resolved)
    console = cli.console()
    console.width -= len(_COMMENT)
    with console.capture() as captured:  # printed last: the plant may be rejected
        console.print("the paper's assumptions for this scenario:")
        terminal_output.print_assumptions(console, assumptions.assumptions(resolved))
        _print_plant(console, resolved)
    if json:
        cli.print_json(resolved.model_dump(mode="json"))
        return
    print(scenario_file.dumps(resolved))
    for line in captured.get().splitlines():
        print(f"{_COMMENT}{line}".rstrip())


def _make_trigger(resolved: "scenario.Scenario") -> None:
    """Make the trigger: some policies need a stable loop, others a user's class."""
    policy = resolution.policy_of(resolved)
    if isinstance(policy, trigger_rule.CodedPolicy):
        policy.new_trigger()


def _check_loops(loaded: "scenario.Scenario", *, json: bool) -> None:
    """Check each loop; print the scenario, which is not resolved."""
    loops = resolution.resolved_loops(loaded)
    for loop in loops:
        _make_trigger(loop)
    if json:
        cli.print_json(loaded.model_dump(mode="json"))
        return
    print(scenario_file.dumps(loaded))
    for loop, phase_ns in zip(loops, scenario.phases_ns(loaded), strict=True):
        x0 = ", ".join(f"{value:.4g}" for value in loop.plant.initial_state)
        print(f"{_COMMENT}{loop.name}: begins at {phase_ns / NS_PER_S:.6f} s, x(0) = ({x0})")


def _print_plant(console: "Console", resolved: "scenario.Scenario") -> None:
    """Print a nonlinear plant's linearisation, and the defaults that depend on other keys."""
    if not resolved.coverage.is_linear:
        about = getattr(plant.system_of(resolved), "about", resolved.plant.system.kind)
        console.print(f"the plant: {about}", highlight=False, markup=False)
    if (law := getattr(controller.law_of(resolved), "about", None)) is not None:
        console.print(f"the controller: {law}", highlight=False, markup=False)
    if (near := plant_linearisation.linearisation(resolved)) is not None:
        for label, value in plant_linearisation.linearisation_rows(near):
            console.print(f"{label}: {value}", highlight=False, markup=False)
    for line in _dependent_defaults(resolved):
        console.print(line, highlight=False, markup=False)


def _dependent_defaults(resolved: "scenario.Scenario") -> Iterator[str]:
    """Yield the keys without a value whose default depends on other keys, and what has no effect."""
    if resolved.network.mansd == 0 and resolved.network.loss.model != "lossless":
        yield "network.loss: no effect, since network.mansd = 0 lets every update pass"
    if resolved.controller.timeout_input == "hold" and resolved.controller.update_timeout_s is None:
        yield "controller.timeout_input: no effect without controller.update_timeout_s"
    if isinstance(resolved.trigger, periodic_trigger.PeriodicSettings):
        period_s, measured_ns = resolved.trigger.period_s, resolved.timing.measurement_period_ns
        sent_ns = -(-round(period_s * NS_PER_S) // measured_ns) * measured_ns
        if sent_ns != round(period_s * NS_PER_S):
            yield f"trigger.period_s: updates are sent at measurements, every {sent_ns / NS_PER_S:g} s"
    watchdog, timeout_s = resolved.plant.watchdog, resolved.timing.actuation_timeout_ns / NS_PER_S
    if watchdog.timeout_s is None:
        yield (f"plant.watchdog: policy {watchdog.policy}, after {timeout_s:g} s without an actuation")
    if resolved.controller.safe_input is None:
        yield "controller.safe_input: 0, the input before the first update"
    if resolved.start_within_s is None:
        yield (
            f"start_within_s: {launcher.DEFAULT_START_S:g}, longer on a busy machine; with "
            "`noack record`: unlimited"
        )


@cli.command(cli.FILES, 40)
def schema(
    *,
    netem: Annotated[bool, Option("--netem")] = False,
    campaign: Annotated[bool, Option("--campaign")] = False,
    json: opt.JsonOption = False,
) -> None:
    """Print the JSON Schema of scenario files, for editors.

    Options:
        netem: Print the schema of the emulator's links files.
        campaign: Print the schema of campaign files.

    Examples:
        noack schema > scenario.schema.json   for an editor that completes keys
        noack schema --campaign   the schema of campaign files
        noack schema --netem   the schema of the emulator's links files
    """
    if campaign:
        cli.print_json(campaign_file.json_schema())
    elif netem:
        cli.print_json(links_file.json_schema())
    else:
        cli.print_json(toml_file.json_schema(scenario.Scenario))


@cli.command(cli.FILES, 12, takes="about a second")
def linearise(
    plant: PlantArgument,
    settings: opt.SetOption = None,
    *,
    at: str | None = None,
    operating_input: Annotated[str | None, Option("--input")] = None,
    within: float = 0.1,
    out: opt.OutOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Print the linear model of a plant, its error, its eigenvalues and its controllable part.

    A plant with a derivative is differentiated; another one is moved, and the matrix logarithm of a
    step is taken. This runs the code of a plant in Python.

    Options:
        at: x at the point, e.g. 0,0,0.1,0; by default 0.
        operating_input: u at the point; by default 0.
        within: Half-width of the neighbourhood in which the error is sampled.
        out: Write the model as JSON, for gain and new.

    Examples:
        noack linearise cart_pole   a plant that comes with noack
        noack linearise pole.py:Pole --out pole.json   a class of yours; write the model
        noack linearise four_tank --set plant.system.voltages_v=[4.0,4.0] --json   as JSON
    """
    model = linear_model.linearise(
        plant,
        at=_numbers("--at", at),
        input=_numbers("--input", operating_input),
        settings=_settings(settings),
        within=within,
    )
    _show(model, out, json=json)


@cli.command(cli.FILES, 14, takes="about a second")
def gain(
    plant: PlantArgument,
    settings: opt.SetOption = None,
    *,
    q: Annotated[str | None, Option("--q")] = None,
    r: Annotated[str | None, Option("--r")] = None,
    poles: str | None = None,
    out: opt.OutOption = None,
    json: opt.JsonOption = False,
) -> None:
    """Compute the gain K of u = K x: a linear-quadratic regulator, or given closed-loop poles.

    Options:
        q: Weight of the states in ∫ xᵀQx + uᵀRu dt: a number, or the diagonal, e.g. 10,1,10,1; by
            default 1.
        r: Weight of the inputs, likewise.
        poles: Eigenvalues of Â + B̂K instead, e.g. --poles=-1,-2,-3+1j,-3-1j.
        out: Write the model and the gain as JSON, for new.

    Examples:
        noack gain cart_pole --q 10,1,10,1 --r 0.1   a regulator for these weights
        noack gain pole.json --out pole.json   add a gain to a model that linearise wrote
        noack gain cart_pole --poles=-2,-3,-4,-5 --json   given poles, as JSON
    """
    result = linear_model.gain(
        plant,
        q=_numbers("--q", q),
        r=_numbers("--r", r),
        poles=_numbers("--poles", poles, complex),
        settings=_settings(settings),
    )
    _show(result, out, json=json)


@cli.command(cli.FILES, 16, takes="some 10 s")
def new(
    file: Annotated[Path, Argument(metavar="FILE.toml", help="The scenario file to write.")],
    settings: opt.SetOption = None,
    *,
    plant: Annotated[str, Option("--plant", metavar="PLANT")],
    x0: Annotated[str | None, Option("--x0")] = None,
    json: opt.JsonOption = False,
) -> None:
    """Write a complete scenario for a plant, with comments, and settings that are certified.

    The gain is chosen, too, unless the plant is a file that gain wrote. Choose it by weights or
    poles there: `noack gain PLANT --q 10,1 --r 0.1 --out pole.json`. If no certificate is found,
    the scenario is written all the same, with the reason. --set fixes settings.

    Options:
        plant: As for linearise.
        x0: The initial state x(0), e.g. 0.1,0,0.1,0; by default chosen.

    Examples:
        noack new pole.toml --plant pole.py:Pole   everything from a class of yours
        noack new pole.toml --plant pole.json   from the file of linearise or gain
        noack new tanks.toml --plant four_tank --set network.mansd=2   keep a setting
    """
    if file.suffix != ".toml":
        raise CallerError(f"{file}: the name of a scenario file ends in .toml")
    if file.exists():
        raise CallerError(f"{file}: exists; give another name, or remove it first")
    if not file.parent.is_dir():
        raise CallerError(f"{file}: there is no folder {file.parent}")
    with cli.status("linearising") as change:
        result = new_scenario.new(
            plant,
            file,
            initial_state=_numbers("--x0", x0),
            settings=_settings(settings),
            report=change,
        )
    result.save(file)
    following = f"wrote {file}; now noack check, certify, simulate or run {file}"
    cli.print_lines(json, result.to_json(), *result.notes, following)


def _settings(assignments: Sequence[str] | None) -> "Table":
    """Return the values of --set by their keys."""
    return dict(
        scenario_file.setting_of(assignment, "plant.system.cart_kg=1.0") for assignment in assignments or ()
    )


def _numbers(option: str, text: str | None, kind: Callable[[str], Number] = float) -> list[Number] | None:
    if text is None:
        return None
    try:
        return [kind(word) for word in text.replace(" ", "").strip("[]()").split(",")]
    except ValueError:
        raise CallerError(f"{option} {text}: give numbers with commas, e.g. -1,-0.5") from None


def _show(
    result: "linear_model.LinearModel | linear_model.LoopGain", out: Path | None, *, json: bool
) -> None:
    """Print a result, and write its document, not over that of another plant."""
    if out is not None:
        if out.suffix != ".json":
            raise CallerError(f"--out {out}: the name of a model ends in .json")
        label = result.to_json()["plant"]
        if out.exists() and (other_plant := linear_model.read_document(out)["plant"]) != label:
            raise CallerError(f"--out {out}: has the model of {other_plant}; give another name")
        write_whole(out, json_format.dumps(result.to_json(), indent=2))
    cli.print_lines(json, result.to_json(), repr(result))
