"""Presets as text: the list of ``noack netem --presets``, and what ``--explain`` says of one."""

import json
from collections.abc import Iterable, Iterator

from rich.console import Console
from rich.table import Table
from rich.text import Text

from netem.core.command_line import netem_program
from netem.core.console import SafeConsole
from netem.core.errors import shortened
from netem.presets.preset import Preset

_LONGEST_WORDS = 160
"""Words of a preset are cut to this number of characters in the list."""


def print_list(presets: Iterable[Preset], *, as_json: bool) -> None:
    """Print presets on standard output: name, sentence, words and source of each."""
    if as_json:
        print(json.dumps({"presets": [preset.content() for preset in presets]}))
        return
    console = SafeConsole(highlight=False)
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    table.add_column("preset", style="bold", no_wrap=True)
    table.add_column("network, words and source", overflow="fold")
    for preset in presets:
        lines = (f"{key}: {value}" for key, value in _rows(preset, _LONGEST_WORDS))
        table.add_row(preset.name, Text("\n".join((preset.sentence, *lines))))
    console.print(table)
    console.print(
        Text(f"\nTo use one: like NAME; to see all its words: {netem_program()} --explain like NAME")
    )


def print_explanation(console: Console, preset: Preset) -> None:
    """Print what a preset stands for, and where its numbers are from."""
    console.print(Text(f"like {preset.name}: {preset.sentence}", "bold"))
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, show_header=False)
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    for key, value in (*_rows(preset), ("fit", preset.fit)):
        table.add_row(key, Text(value))
    console.print(table)
    console.print()


def _rows(preset: Preset, longest: int | None = None) -> Iterator[tuple[str, str]]:
    for direction in ("forward", "reverse"):
        words = preset.words(direction) or "no impairment"
        yield direction, words if longest is None else shortened(words, longest)
    yield "source", preset.source_text
