"""The documentation's commands: each is parsed and its scenario resolved, and one of each is run."""

import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from cosim.cli import options
from cosim.cli.application import app
from noack.scenario.resolution import resolve_run
from tests.helpers.command_line import invoke
from tests.helpers.pages import PAGES, blocks, target_exists

LIVE = {"demo", "run"}
"""Commands that start processes under a real clock."""


def documented(page: str) -> Iterator[str]:
    for block in blocks(page, "sh"):
        lines = (line.partition("#")[0].strip() for line in block.replace("\\\n", "").splitlines())
        yield from (line.removeprefix(".venv/bin/") for line in filter(None, lines))


def words_of(command: str) -> list[str]:
    """The words after the program's name; an emulator is not started, but explained."""
    words = shlex.split(command.partition(" > ")[0])[1:]
    if "--listen" in words or "--links" in words:
        words.insert(1, "--explain")  # tests/integration/test_netem.py starts an emulator
    return words


WRITING = ("--out", "--write")
"""Options by which another command writes a file that a command reads."""
COMMANDS = sorted({command for page in PAGES for command in documented(page)})
OF_NOACK = [command for command in COMMANDS if command.startswith("noack ")]
RUN = {words_of(command)[0]: command for command in reversed(OF_NOACK) if "--help" not in command}
"""One command line for each command that the documentation shows."""


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
    command: str, documented_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(documented_folder)
    words = words_of(command)
    given = parsed(words)
    if words[0] == "netem":
        assert invoke(*words).exit_code == 0
        return
    files = [str(given[key]) for key in ("scenario", "network") if given.get(key) is not None]
    is_written = any(f"{way} {file}" in other for file in files for other in OF_NOACK for way in WRITING)
    if isinstance(given.get("scenario"), str) and not Path(files[0]).is_dir() and not is_written:
        resolve_run(options.load_scenario(given["scenario"], given.get("settings"), given.get("network")))


SHORTER = {
    "simulate": ("--no-report", "--set", "horizon_s=1"),
    "demo": ("--no-report", "--set", "certificate.prove=false"),
    "campaign": ("--workers", "1", "--draws", "10"),
    "adversary": ("--set", "horizon_s=2", "--nodes", "500"),
    "design": ("--draws", "80"),
    "margin": ("--no-period", "--most", "2"),
    "doctor": ("--seconds", "0.1"),
    "certify": ("--no-search",),
}
"""Arguments added to a command to shorten it; other tests cover reports, figures of pages and long runs."""


def shorter(words: list[str]) -> list[str]:
    more = list(("--effort", "5") if "--effort" in words else SHORTER.get(words[0], ()))
    more = ["--figure", "errors"] if "pdf" in words else more
    if "horizon_s" in " ".join(words):
        more = more[2:] if words[0] == "adversary" else more[:1]
    for option in ({*more} & {*words}) - {"--set"}:  # it is given once
        value = 0 if option.startswith("--no-") else 1
        words = words[: words.index(option)] + words[words.index(option) + 1 + value :]
    return [*words, *more]


def run(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = words_of(command)
    monkeypatch.chdir(folder)
    finished = invoke(*shorter(words))
    assert finished.exit_code == 0, finished.output
    if "--json" in words:
        json.loads(finished.stdout)


@pytest.mark.usefixtures("without_viewer", "no_drawing", "no_searches")
@pytest.mark.parametrize(
    "command", [pytest.param(RUN[name], marks=[pytest.mark.live] * (name in LIVE)) for name in sorted(RUN)]
)
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
