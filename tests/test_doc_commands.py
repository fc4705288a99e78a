"""The documentation's commands: each is parsed and its scenario resolved, and one of each is run."""

from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from cosim.cli import options
from cosim.cli.application import app
from noack.scenario.resolution import resolve_run
from tests.helpers.command_line import invoke
from tests.helpers.documented_commands import COMMANDS, LIVE, OF_NOACK, RUN, documented, run, words_of
from tests.helpers.pages import PAGES, target_exists

WRITING = ("--out", "--write")
"""Options by which another command writes a file that a command reads."""


def test_every_command_line_begins_with_a_known_program() -> None:
    assert {command.split()[0] for command in COMMANDS} == {"make", "noack"}


@pytest.mark.parametrize("command", [command for command in COMMANDS if command.startswith("make ")])
def test_a_target_of_make_exists(command: str) -> None:
    assert target_exists(command)


def parsed(words: list[str]) -> dict[str, Any]:
    """Return the parameters that the command line gives to its command, without running it."""
    program = get_command(app)
    with program.make_context("noack", [*words]) as context:
        name, command, rest = program.resolve_command(context, words)  # type: ignore[attr-defined]
        with command.make_context(name, rest, parent=context) as own:
            return dict(own.params)


@pytest.mark.parametrize("command", [command for command in OF_NOACK if "--help" not in command])
def test_a_command_line_is_understood_and_its_scenario_resolved(
    command: str, unchanged_documented_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(unchanged_documented_folder)
    words = words_of(command)
    given = parsed(words)
    if words[0] == "netem":
        assert invoke(*words).exit_code == 0
        return
    files = [str(given[key]) for key in ("scenario", "network") if given.get(key) is not None]
    is_written = any(f"{way} {file}" in other for file in files for other in OF_NOACK for way in WRITING)
    if isinstance(given.get("scenario"), str) and not Path(files[0]).is_dir() and not is_written:
        resolve_run(options.load_scenario(given["scenario"], given.get("settings"), given.get("network")))


@pytest.mark.usefixtures("without_viewer", "no_drawing", "no_searches")
@pytest.mark.parametrize("command", [RUN[name] for name in sorted(RUN.keys() - LIVE)])
def test_one_of_each_command_runs(
    command: str, documented_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(command, documented_folder, monkeypatch)


@pytest.mark.deep
@pytest.mark.usefixtures("without_viewer", "no_drawing", "no_searches")
@pytest.mark.parametrize("page", PAGES)
def test_the_commands_of_a_page_run_in_their_order(
    page: str, documented_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for command in documented(page):
        if command.startswith("noack "):
            run(command, documented_folder, monkeypatch)
