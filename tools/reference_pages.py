"""Generates parts of the documentation from the program, so that they are always up to date.

A Sphinx extension: it replaces ``<!-- made: NAME -->`` in a page by the generated text NAME.
"""

import contextlib
import io
import os
import re
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

from typer.main import get_command

from cosim.cli.application import app
from noack.network_process.__main__ import main as netem_main

ROOT = Path(__file__).parents[1]
_MARK = re.compile(r"^<!-- made: ([a-z_ ]+) -->$", re.MULTILINE)


def commands() -> str:
    """Return every command with its options and examples, under the panels of its help."""
    program: Any = get_command(app)
    context = program.context_class(program, info_name="noack")
    pages: dict[str, list[str]] = {}
    for name in program.list_commands(context):
        command = program.get_command(context, name)
        if not command.hidden:
            pages.setdefault(command.rich_help_panel, []).append(_command(name, command, context))
    return "\n".join("\n".join([f"## {panel}\n", *made]) for panel, made in pages.items())


def _command(name: str, command: Any, parent: Any) -> str:
    context = command.context_class(command, info_name=name, parent=parent)
    lines = [f"### noack {name}", "", command.help or "", ""]
    if name == "netem":
        return "\n".join([*lines, "```text", _netem_help(), "```", ""])
    usage = " ".join(["noack", name, *command.collect_usage_pieces(context)])
    records = [parameter.get_help_record(context) for parameter in command.params]
    rows = [(what, _meaning(meaning)) for what, meaning in filter(None, records)]
    lines += ["```text", usage.replace("{", "").replace("}", ""), "```", ""]
    if rows:
        lines += ["| | |", "|---|---|"]
        lines += [f"| `{_cell(what)}` | {_cell(meaning).replace('<', '&lt;')} |" for what, meaning in rows]
    if command.epilog:
        lines += ["", command.epilog]
    return "\n".join([*lines, ""])


def _meaning(record: str) -> str:
    """Return an option's help, and the text in brackets after it: default, required."""
    text, gap, more = record.rpartition("  [")
    return f"{text} ({more.removesuffix(']')})" if gap else record


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _netem_help() -> str:
    output = io.StringIO()
    with (
        patch.dict(os.environ, COLUMNS="100"),
        patch("sys.argv", ["noack"]),
        contextlib.redirect_stdout(output),
        contextlib.suppress(SystemExit),
    ):
        netem_main(["--help"])
    return output.getvalue().strip()


def shipped(folder: str) -> str:
    """Return every file of ``scenarios`` or ``campaigns``: its description and its text."""
    return "\n".join(_shipped(folder))


def _shipped(folder: str) -> Iterator[str]:
    for path in sorted((ROOT / folder).glob("*.toml")):
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines()
        body = "\n".join(line for line in lines if not line.startswith("#:schema"))
        yield f"## {path.stem}\n\n{tomllib.loads(text).get('description', '')}\n"
        yield f"```toml\n{body}\n```\n"


def example(name: str) -> str:
    """Return a program of ``docs/examples``, divided into cells, as a page of prose and code."""
    text = (ROOT / f"docs/examples/{name}.py").read_text(encoding="utf-8")
    cells = (cell.partition("\n") for cell in f"\n{text}".split("\n# %%")[1:])
    return "\n\n".join(
        "\n".join(line.removeprefix("#").removeprefix(" ") for line in body.strip().splitlines())
        if kind == " [markdown]"
        else f"```python\n{body.strip()}\n```"
        for kind, _, body in cells
    )


MADE: dict[str, Callable[[], str]] = {
    "commands": commands,
    "scenarios": lambda: shipped("scenarios"),
    "campaigns": lambda: shipped("campaigns"),
    "example own_plant": lambda: example("own_plant"),
    "example model_or_hold": lambda: example("model_or_hold"),
}


def fill_in(page: str) -> str:
    """Return a page with its marks replaced by the generated texts."""
    return _MARK.sub(lambda mark: MADE[mark[1]](), page)


def setup(sphinx: Any) -> dict[str, bool]:
    """Make Sphinx fill in every page that it reads."""

    def on_read(_sphinx: Any, _name: str, source: list[str]) -> None:
        source[0] = fill_in(source[0])

    sphinx.connect("source-read", on_read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
