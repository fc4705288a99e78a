"""The help and the completion: examples that work, and the words that fit."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from rich.cells import cell_len
from typer.main import get_command
from typer.testing import CliRunner

from cosim.cli.application import app, examples_of
from netem.control.emulator_commands import COMMANDS as EMULATOR_COMMANDS
from tests.helpers.approved import compare_lines
from tests.helpers.command_line import invoke

PROGRAM: Any = get_command(app)
COMMANDS: dict[str, Any] = dict(PROGRAM.commands)
OURS = sorted(COMMANDS.keys() - {"netem"})
"""netem has its own vocabulary; its help is by argparse."""


def help_of(*command: str) -> str:
    result = invoke(*command, "--help")
    assert result.exit_code == 0
    return result.stdout


def examples() -> list[tuple[str, str]]:
    return [(name, line) for name in OURS for line in examples_of(COMMANDS[name])]


def words_of(example: str) -> list[str]:
    """An example's arguments, without the redirection of its output."""
    return shlex.split(example.partition(">")[0])[1:]


@pytest.mark.parametrize("command", ["", *OURS])
def test_help_fits_a_terminal_and_has_examples(command: str) -> None:
    text = help_of(*filter(None, [command]))
    assert max(map(cell_len, text.splitlines())) <= 80
    unwrapped = " ".join(text.split())
    if not command:
        return
    examples = examples_of(COMMANDS[command])
    assert len(examples) >= 2
    for example in examples:
        assert words_of(example)[0] == command
        assert example in unwrapped
    assert "--json" in {name for option in COMMANDS[command].params for name in option.opts}


@pytest.mark.parametrize("command", ["", *EMULATOR_COMMANDS])
def test_the_emulators_help_ends_with_examples(command: str) -> None:
    text = help_of("netem", *filter(None, [command]))
    assert re.search(r"^examples:\n(  noack netem .*\n(    .*\n)*)+\Z", text, re.MULTILINE)


@pytest.mark.parametrize(("command", "example"), examples())
def test_every_example_has_valid_arguments(
    command: str, example: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    PROGRAM.make_context("noack", words_of(example))
    COMMANDS[command].make_context(command, words_of(example)[1:])


def completed(line: str) -> list[str]:
    """The completions that bash offers for the last word of a line."""
    position = str(len(line.split(" ")) - 1)
    environment = {"_NOACK_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": position}
    result = CliRunner().invoke(app, env=environment, prog_name="noack")
    assert result.stderr == ""
    return result.stdout.split()


def test_words_are_completed_as_approved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("20260101-000000-a", "20260102-000000-b"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "scenario.toml").touch()
    (tmp_path / "runs" / "campaigns").mkdir()
    (tmp_path / "runs" / "latest").symlink_to("20260102-000000-b")
    compare_lines(Path(__file__).with_name("completions.txt"), completed)
