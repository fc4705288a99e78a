"""``noack set``: change the runtime parameters of a running run."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cosim.cli import command as cli
from cosim.cli import completion
from noack.core.errors import CallerError, ExitStatus

if TYPE_CHECKING:
    from rich.console import Console


@cli.command(
    cli.RUNS, 45,
    [
        ("noack set", "list the runtime parameters and their values"),
        ("noack set loss.p 0.9", "lose nine in ten packets from now on"),
        ("noack set mansd 2 trigger.beta 0.3 --json", "change M − 1 and β at once"),
    ],
    name="set",
    context_settings={"ignore_unknown_options": True},  # -0.5 is a value
)  # fmt: skip
def set_(
    settings: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[KEY VALUE]...",
            help="Keys of the scenario, or their short forms, with new values: loss.p 0.9 mansd 2. "
            "Without keys, list the runtime parameters.",
            autocompletion=completion.runtime_parameters,
        ),
    ] = None,
    *,
    session: Annotated[str | None, cli.SESSION] = None,
    run: Annotated[
        Path | None,
        typer.Option(
            "--run",
            help="Directory of the run; needed if several runs are active.",
            autocompletion=completion.run_directories,
        ),
    ] = None,
    json: cli.JsonOption = False,
) -> int:
    """Change a live run: losses, M, trigger, set point."""
    from noack.config.runtime_parameters import text_of
    from noack.runtime.run_registry import find, request_change

    wanted = parsed(settings or ())
    answer = request_change(find(session, run), wanted)
    if json:
        cli.print_json(answer)
    elif wanted:
        console = cli.console()
        console.print(
            f"{answer['name']}: {text_of(wanted)} from {answer['from_s']:.3f} s on",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
    else:
        _print_parameters(cli.console(), answer)
    return ExitStatus.OK


def parsed(words: list[str] | tuple[str, ...]) -> dict[str, Any]:
    """Return the settings that words give as KEY VALUE or KEY=VALUE.

    Raises:
        CallerError: a value is missing, or a key is given twice.
    """
    found: dict[str, Any] = {}
    from noack.config.runtime_parameters import full_key
    from noack.config.scenario_file import value_of

    left = list(words)
    while left:
        word = left.pop(0)
        name, equals, text = word.partition("=")
        if not equals:
            if not left:
                raise CallerError(f"{word}: needs a value, e.g. `noack set loss.p 0.9`")
            text = left.pop(0)
        key = full_key(name.strip())
        if key in found:
            raise CallerError(f"{key}: is given twice")
        found[key] = value_of(text, name)
    return found


def _print_parameters(console: "Console", answer: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from noack.config.runtime_parameters import SHORT, text_of

    short = {key: name for name, key in SHORT.items()}
    table = Table(title=f"{answer['name']}, at {answer['t_s']:.1f} s")
    for heading in ("key", "short", "value"):
        table.add_column(heading)
    for key, value in answer["runtime_parameters"].items():
        shown = text_of({"": value}).removeprefix(" = ")
        table.add_row(key, short.get(key, ""), escape(shown))
    console.print(table)
    console.print(f"[dim]{escape(answer['run_dir'])}[/]", soft_wrap=True)
