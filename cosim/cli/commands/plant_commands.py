"""``noack linearise``, ``gain``, ``new``: from a plant to a scenario."""

import json as json_format
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

from typer import Argument, Option

from cosim.cli import command as cli
from cosim.lazy_modules import lazy_modules
from noack.core.errors import CallerError, MachineError, why
from noack.core.file_access import new_file

with lazy_modules():
    from cosim.studies.new_loop import linear_model, new_scenario
    from noack.scenario import scenario_file

if TYPE_CHECKING:
    from noack.settings.section import Table

Number = TypeVar("Number", float, complex)
PlantArgument = Annotated[
    str,
    Argument(
        metavar="PLANT",
        help="FILE.py:Class, FILE.fmu, gymnasium:ID, a kind of plant such as cart_pole, a "
        "scenario, or a file that linearise or gain wrote.",
    ),
]


@cli.command(cli.FILES, 12, takes="about a second")
def linearise(
    plant: PlantArgument,
    settings: cli.SetOption = None,
    *,
    at: str | None = None,
    held: Annotated[str | None, Option("--input")] = None,
    within: float = 0.1,
    out: cli.OutOption = None,
    json: cli.JsonOption = False,
) -> None:
    """Print the linear model of a plant, its error, its eigenvalues and its controllable part.

    A plant with a derivative is differentiated; another one is moved, and the matrix logarithm of a
    step is taken. This runs the code of a plant in Python.

    Options:
        at: x at the point, e.g. 0,0,0.1,0; by default 0.
        held: u at the point; by default 0.
        within: Half-width of the neighbourhood in which the error is sampled.
        out: Write the model as JSON, for gain and new.

    Examples:
        noack linearise cart_pole   a plant that comes with noack
        noack linearise pole.py:Pole --out pole.json   a class of yours; write the model
        noack linearise four_tank --set plant.system.voltages_v=[4.0,4.0] --json   as JSON
    """
    found = linear_model.linearise(
        plant,
        at=_numbers("--at", at),
        input=_numbers("--input", held),
        settings=_settings(settings),
        within=within,
    )
    _show(found, out, json=json)


@cli.command(cli.FILES, 14, takes="about a second")
def gain(
    plant: PlantArgument,
    settings: cli.SetOption = None,
    *,
    q: Annotated[str | None, Option("--q")] = None,
    r: Annotated[str | None, Option("--r")] = None,
    poles: str | None = None,
    out: cli.OutOption = None,
    json: cli.JsonOption = False,
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
    found = linear_model.gain(
        plant,
        q=_numbers("--q", q),
        r=_numbers("--r", r),
        poles=_numbers("--poles", poles, complex),
        settings=_settings(settings),
    )
    _show(found, out, json=json)


@cli.command(cli.FILES, 16, takes="some 10 s")
def new(
    file: Annotated[Path, Argument(metavar="FILE.toml", help="The scenario file to write.")],
    settings: cli.SetOption = None,
    *,
    plant: Annotated[str, Option("--plant", metavar="PLANT")],
    x0: Annotated[str | None, Option("--x0")] = None,
    json: cli.JsonOption = False,
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
    with cli.status("linearising") as status:
        found = new_scenario.new(
            plant,
            file,
            initial_state=_numbers("--x0", x0),
            settings=_settings(settings),
            report=status.update,
        )
    found.save(file)
    following = f"wrote {file}; now noack check, certify, simulate or run {file}"
    cli.print_lines(json, found.to_json(), *found.notes, following)


def _settings(given: Sequence[str] | None) -> "Table":
    """Return the values of --set by their keys."""
    found: Table = {}
    for one in given or ():
        key, equals, text = one.partition("=")
        if not equals:
            raise CallerError(f"--set {one}: write it as key=value, e.g. plant.system.cart_kg=1.0")
        found[key.strip()] = scenario_file.value_of(text, f"--set {key}")
    return found


def _numbers(option: str, text: str | None, kind: Callable[[str], Number] = float) -> list[Number] | None:
    if text is None:
        return None
    try:
        return [kind(one) for one in text.replace(" ", "").strip("[]()").split(",")]
    except ValueError:
        raise CallerError(f"{option} {text}: give numbers with commas, e.g. -1,-0.5") from None


def _show(found: "linear_model.LinearModel | linear_model.LoopGain", out: Path | None, *, json: bool) -> None:
    """Print a result, and write its document, not over that of another plant."""
    if out is not None:
        if out.suffix != ".json":
            raise CallerError(f"--out {out}: the name of a model ends in .json")
        label = found.to_json()["plant"]
        if out.exists() and (other := linear_model.read_document(out)["plant"]) != label:
            raise CallerError(f"--out {out}: has the model of {other}; give another name")
        try:
            with new_file(out, make_folder=False) as file:
                file.write(json_format.dumps(found.to_json(), indent=2).encode())
        except OSError as error:
            raise MachineError(f"--out {out}: cannot be written: {why(error)}") from None
    cli.print_lines(json, found.to_json(), repr(found))
