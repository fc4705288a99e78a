"""The help: an introduction, examples that work, and one word for each concept."""

import json
import re
import shlex
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from cosim.cli import app
from cosim.cli.command import examples_of
from netem.control.emulator_commands import COMMANDS as EMULATOR_COMMANDS

PROGRAM: Any = get_command(app)
COMMANDS: dict[str, Any] = dict(PROGRAM.commands)
OURS = sorted(COMMANDS.keys() - {"netem"})
"""netem has its own vocabulary; its help is by argparse."""


def help_of(*command: str) -> str:
    done = CliRunner().invoke(app, [*command, "--help"], prog_name="noack")
    assert done.exit_code == 0
    return done.stdout


def examples() -> list[tuple[str, str]]:
    return [(name, line) for name in OURS for line in examples_of(COMMANDS[name])]


def words_of(example: str) -> list[str]:
    """An example's arguments, without the redirection of its output."""
    return shlex.split(example.partition(">")[0])[1:]


@pytest.mark.parametrize("command", ["", *OURS])
def test_help_fits_a_terminal(command: str) -> None:
    text = help_of(*filter(None, [command]))
    assert max(map(len, text.splitlines())) <= 80
    wrapped = [" ".join(line.split()) for line in text.splitlines()]
    for example in examples_of(COMMANDS[command]) if command else []:
        assert any(line.startswith(example) for line in wrapped), example


@pytest.mark.parametrize("command", OURS)
def test_every_help_page_ends_with_examples(command: str) -> None:
    found = examples_of(COMMANDS[command])
    assert len(found) >= 2
    assert all(words_of(example)[0] == command for example in found)


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


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder, with a run in virtual time if needed."""
    folder = tmp_path_factory.mktemp("examples")
    words = ["simulate", "lane_following", "--set", "horizon_s=2", "--no-report"]
    done = CliRunner().invoke(app, [*words, "--runs", str(folder / "runs")])
    assert done.exit_code == 0, done.output
    return folder


MORE = {
    "archive": (),
    "check": (),
    "export": (),
    "schema": (),
    "summary": (),
    "replay": (),
    "fidelity": (),
    "report": (),
    "scenarios": (),
    "measure": (),
    "certify": (),
    "margin": ("--most", "2", "--no-period"),
    "simulate": ("--set", "horizon_s=1", "--no-report"),
    "adversary": ("--nodes", "200", "--beam", "2", "--set", "horizon_s=0.5"),
}
"""Commands of which the first and last example (for slow ones the first) are run, shortened."""


def run_examples() -> list[str]:
    found = []
    for command in MORE:
        first, *_, last = examples_of(COMMANDS[command])
        found += [first] if command in ("certify", "margin", "report") else [first, last]
    return found


@pytest.mark.parametrize("example", run_examples())
def test_examples_work(example: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    words = words_of(example)
    done = CliRunner().invoke(app, [*words, *MORE[words[0]]])
    assert done.exit_code == 0, done.output
    if "--json" in words or words[0] == "schema":
        json.loads(done.stdout)


def test_only_long_and_live_commands_have_no_example_that_is_run() -> None:
    assert set(OURS) - MORE.keys() == {
        "campaign", "capacity", "collect", "compare", "controller", "demo", "design", "doctor",
        "lab", "paper", "plant", "record", "reproduce", "run", "sensor", "set", "view",
    }  # fmt: skip


@pytest.mark.parametrize("command", OURS)
def test_every_command_has_a_json_option(command: str) -> None:
    assert "--json" in {name for one in COMMANDS[command].params for name in one.opts}


OF_THEIR_OWN = {
    "--draws": "at each grid point, in all, to choose by",
    "--format": "of figures, or of an export",
    "--invitation": "the file to write, or to join by",
    "--listen": "where probes arrive, or where processes of other hosts join",
    "--out": "a folder of results, or a scenario file",
    "--runs": "where they are made, or the last one is looked for",
}
"""Options with a different meaning in each command, which their help states."""


def test_an_option_has_one_name_and_one_meaning() -> None:
    meanings: dict[str, set[tuple[str, str | None, str | None]]] = defaultdict(set)
    names: dict[str, set[str]] = defaultdict(set)
    for command in OURS:
        for one in COMMANDS[command].params:
            if one.help:
                names[one.help].add(one.name)
            if one.param_type_name == "option":
                variant = "/".join(one.secondary_opts), one.metavar, one.help
                meanings["/".join(one.opts)].add(variant)
    several = {name for name, variants in meanings.items() if len(variants) > 1}
    assert several <= OF_THEIR_OWN.keys(), {name: meanings[name] for name in several}
    assert not [variants for variants in names.values() if len(variants) > 1]


def test_arguments_have_few_names() -> None:
    arguments: dict[str, set[str | None]] = defaultdict(set)
    for name in OURS:
        for one in COMMANDS[name].params:
            if one.param_type_name == "argument":
                arguments[one.name].add(name)
    assert arguments.keys() == {
        "scenario", "run_dir", "directories", "recording", "file", "name", "settings",
        "sources",
    }  # fmt: skip
