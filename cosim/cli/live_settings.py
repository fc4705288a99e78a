"""``noack set``: the settings that its words give, and the table of the runtime parameters."""

from pathlib import Path

from rich.console import Console

from netem.core.errors import CallerError
from netem.output.result_tables import ResultTable
from netem.output.terminal_writer import terminal_table
from noack.runtime.control_messages import ChangeReply
from noack.scenario.runtime_parameters import SHORT, full_key, text_of
from noack.scenario.scenario_file import value_of


def parse_settings(words: list[str] | tuple[str, ...]) -> dict[str, object]:
    """Return the settings that words give as KEY VALUE or KEY=VALUE.

    Raise CallerError if a value is missing, or a key is given twice.
    """
    settings: dict[str, object] = {}
    remaining = list(words)
    while remaining:
        word = remaining.pop(0)
        name, equals, text = word.partition("=")
        if not equals:
            if Path(word).is_dir():
                raise CallerError(f"{word}: a folder, not a key; a run is given by --run {word}")
            if not remaining:
                raise CallerError(f"{word}: needs a value, e.g. `noack set loss.p 0.9`")
            text = remaining.pop(0)
        key = full_key(name.strip())
        if key in settings:
            raise CallerError(f"{key}: is given twice")
        settings[key] = value_of(text, name)
    return settings


def print_parameters(console: Console, answer: ChangeReply) -> None:
    """Print the runtime parameters of a run and their values."""
    short = {key: name for name, key in SHORT.items()}
    entries, rows = answer.loops, []
    for key in dict.fromkeys(key for values in entries.values() for key in values):
        names: dict[str, list[str]] = {}
        for name, values in entries.items():
            if key in values:
                text = text_of({"": values[key]}).removeprefix(" = ")
                names.setdefault(text, []).append(name)
        for value, loops in names.items():
            loop_text = "all" if len(loops) == len(entries) else ", ".join(loops)
            rows.append((key, short.get(key, ""), loop_text, value))
    title = f"{answer.name}, at {answer.t_s:.1f} s"
    table = ResultTable("", title, ("key", "short", "loops", "value"), rows, left=range(4))
    console.print(terminal_table(table))
    console.print(answer.run_dir, style="dim", markup=False, soft_wrap=True)
