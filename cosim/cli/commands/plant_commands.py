"""``noack linearise``, ``gain``, ``new``: from a plant to a scenario."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from typer import Argument, Option

from cosim.cli import options as opt
from cosim.cli.options import FILES, examples
from cosim.cli.printing import print_lines, status
from netem.core.errors import CallerError

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
    from cosim.studies.new_loop.linear_model import write_document

    model = linearise_plant(
        plant,
        at=_numbers("--at", at),
        input=_numbers("--input", operating_input),
        settings=_table(settings),
        within=within,
    )
    if out is not None:
        write_document(model, out)
    print_lines(json, model.to_json(), repr(model))


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack gain cart_pole --q 10,1,10,1 --r 0.1", "a regulator for these weights"),
        ("noack gain pole.json --out pole.json", "add a gain to a model that linearise wrote"),
        ("noack gain cart_pole --poles=-2,-3,-4,-5 --json", "given poles, as JSON"),
        ("noack gain servo_reference --integral angle", "with integral action: no steady-state error"),
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
    integral: Annotated[
        str | None,
        Option(
            metavar="NAME",
            help="Integrate r − y of these outputs or states, e.g. angle: K, --q and --poles have an "
            "entry more for each.",
        ),
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
    from cosim.studies.new_loop.linear_model import write_document

    result = gain_of_plant(
        plant,
        q=_numbers("--q", q),
        r=_numbers("--r", r),
        poles=_numbers("--poles", poles, complex),
        integral=() if integral is None else integral.split(","),
        settings=_table(settings),
    )
    if out is not None:
        write_document(result, out)
    print_lines(json, result.to_json(), repr(result))


@app.command(
    rich_help_panel=FILES,
    epilog=examples(
        ("noack new servo.py --allow angle=0.02", "everything from a class of yours: servo.toml"),
        ("noack new pole.json", "from the file of linearise or gain"),
        ("noack new four_tank --out tanks.toml --set network.mansd=2", "keep a setting"),
    ),
)
def new(
    plant: Annotated[str, Argument(metavar="PLANT", help="As for linearise.")],
    out: Annotated[
        Path | None,
        Option(metavar="FILE.toml", help="The scenario file to write; by default with the plant's name."),
    ] = None,
    allow: Annotated[
        list[str] | None,
        Option(metavar="STATE=ERROR", help="Allowed error of a state, in its unit; can be repeated."),
    ] = None,
    settings: opt.SetOption = None,
    network: opt.NetworkOption = None,
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

    Takes some 10 s, and minutes if proofs are hard to find.
    """
    from cosim.studies.new_loop.new_scenario import new as new_scenario
    from cosim.studies.new_loop.new_scenario import require_new_file

    file = Path(f"{Path(plant.rpartition(':')[0] or plant).stem}.toml") if out is None else out
    require_new_file(file)
    with status("linearising") as change:
        result = new_scenario(
            plant,
            file,
            initial_state=_numbers("--x0", x0),
            allowed=_allowed(allow),
            settings=_table(settings),
            network=network,
            report=change,
        )
    result.save(file)
    name = file.stem if file.parent == Path() else file
    following = f"wrote {file}. Next: noack certify {name}; noack run {name}"
    print_lines(json, result.to_json(), result.guarantee, *result.notes, following)


def _table(assignments: Sequence[str] | None) -> dict[str, object]:
    """Return the values of --set by their keys."""
    from noack.scenario.scenario_file import require_keys_once, settings_of

    require_keys_once(assignments or ())
    return dict(settings_of(assignments or (), "plant.system.cart_kg=1.0"))


def _allowed(assignments: Sequence[str] | None) -> dict[str, float] | None:
    """Return the allowed errors by the names of states."""
    if assignments is None:
        return None
    allowed = {}
    for text in assignments:
        name, _, value = text.partition("=")
        if name in allowed:
            raise CallerError(f"--allow {name}: is given twice")
        try:
            allowed[name] = float(value)
        except ValueError:
            raise CallerError(f"--allow {text}: give a state and a number, e.g. angle=0.02") from None
    return allowed


def _numbers(option: str, text: str | None, kind: Callable[[str], Number] = float) -> list[Number] | None:
    if text is None:
        return None
    try:
        return [kind(word) for word in text.replace(" ", "").strip("[]()").split(",")]
    except ValueError:
        raise CallerError(f"{option} {text}: give numbers with commas, e.g. -1,-0.5") from None
