"""Texts of others (a run's summary, names of files) reach the terminal without control characters."""

import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from rich.table import Table

import noack
from cosim.analysis.summary.summary_model import RunSummary
from netem.core.console import SafeConsole
from netem.core.standard_streams import guarded_stream, without_controls

ATTACK = "\x1b]0;title\x07\x1b[2J\x9b31m\r\x08\x7f\u202e"
"""Sets the title, clears the screen, colours, returns to the start of the line, reverses the text."""
SHOWN = r"\x1b]0;title\x07\x1b[2J\x9b31m\r\x08\x7f\u202e"
ESCAPED = r"\x1b]0;title"  # rich discards some characters, and what a column of a table has no room for


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Somebody else's run, with escape sequences in every text of its summary that takes them."""
    scenario = noack.load("lane_following", {"horizon_s": 2.0, "loss.p": 0.9})
    run_dir = noack.simulate(scenario, runs=tmp_path_factory.mktemp("runs")).directory
    summary = json.loads((run_dir / "summary.json").read_text())
    attacked = 0
    for parent, key in list(texts(summary)):
        before = parent[key]
        parent[key] = before + ATTACK
        try:
            RunSummary.model_validate(summary)
        except ValidationError:  # one of few words
            parent[key] = before
        else:
            attacked += 1
    assert attacked > 30
    (run_dir / "summary.json").write_text(json.dumps(summary))
    return run_dir


def texts(part: Any) -> Iterator[tuple[Any, Any]]:
    """Yield where the texts of a document are."""
    for key, value in part.items() if isinstance(part, dict) else enumerate(part):
        if isinstance(value, str):
            yield part, key
        elif isinstance(value, dict | list):
            yield from texts(value)


def output(*words: object, **environment: str) -> str:
    """What a command prints."""
    done = subprocess.run(
        [sys.executable, "-m", "cosim.cli", *map(str, words)],
        env=os.environ | {"COLUMNS": "500"} | environment, capture_output=True, check=False,
    )  # fmt: skip
    return (done.stdout + done.stderr).decode()


def controls(text: str) -> set[str]:
    return {character for character in text if not character.isprintable()} - {"\n", "\xa0"}


@pytest.mark.parametrize("words", [("summary", "--verbose"), ("compare",)])
def test_the_summary_of_another_user_does_not_act_on_the_terminal(
    words: tuple[str, ...], run_dir: Path, tmp_path: Path
) -> None:
    runs = [run_dir, run_dir, "--out", tmp_path / "a.html"] if words[0] == "compare" else [run_dir]
    text = output(words[0], *runs, *words[1:])
    assert "lane_following" in text
    assert controls(text) == set()
    assert words[0] == "compare" or ESCAPED in text


def test_colours_of_the_program_stay(run_dir: Path) -> None:
    text = output("summary", run_dir, "--verbose", FORCE_COLOR="1", TERM="xterm-256color")
    assert "\x1b[1m" in text
    assert controls(text) <= {"\x1b", "\r"}  # and a bar
    assert "\x1b]" not in text
    assert "\x1b[2J" not in text


@pytest.mark.parametrize("command", ["measure", "check"])
def test_names_of_files_do_not_act_on_the_terminal(command: str, tmp_path: Path) -> None:
    (file := tmp_path / f"a{ATTACK}.csv").write_text("sequence,sent_s,received_s\n1,0,0.1\n2,1,\n3,2,2.1\n")
    text = output(command, file)
    assert controls(text) == set()
    assert ESCAPED in text


def test_a_table_and_a_stream_escape_controls() -> None:
    table = Table(title=f"title {ATTACK}")
    table.add_column(f"heading {ATTACK}")
    table.add_row(f"cell {ATTACK}")
    console = SafeConsole(file=(file := io.StringIO()), width=400)
    console.print(table)
    console.print(f"line {ATTACK}", markup=False)
    assert controls(file.getvalue()) == set()
    assert file.getvalue().count(ESCAPED) == 4
    reading, writing = os.pipe()
    with (
        open(writing, "wb") as raw,  # noqa: PTH123
        io.TextIOWrapper(raw, encoding="utf-8", line_buffering=True) as stream,
    ):
        print(f"a\tb {ATTACK}", file=guarded_stream(stream))
    assert os.read(reading, 1000).decode() == f"a\tb {SHOWN}\n"
    os.close(reading)


def test_layout_and_spaces_are_no_control_characters() -> None:
    for text in ("a\n\tb", "a\xa0b\u202fc", "‖x‖ ≤ 3"):
        assert without_controls(text) == text
