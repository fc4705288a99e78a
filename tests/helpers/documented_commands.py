"""The command lines that the documentation shows, and how a test runs them, shortened."""

import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.command_line import invoke
from tests.helpers.pages import PAGES, blocks

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


COMMANDS = sorted({command for page in PAGES for command in documented(page)})
OF_NOACK = [command for command in COMMANDS if command.startswith("noack ")]
RUN = {words_of(command)[0]: command for command in reversed(OF_NOACK) if "--help" not in command}
"""One command line for each command that the documentation shows."""


SHORTER = {
    "simulate": ("--no-report", "--set", "horizon_s=1"),
    "demo": ("--no-report", "--set", "certificate.prove=false"),
    "campaign": ("--workers", "1", "--draws", "3"),
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
    given = {word for word in {*more} & {*words} if word.startswith("--")}
    for option in given - {"--set"}:  # an option is given once
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
