"""The tutorial of the documentation: its steps, its files, and what its commands print."""

import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.helpers.pages import fences

PAGE = "docs/tutorial.md"
NUMBER = re.compile(r"-?\d[\d,.]*(?:e[-+]?\d+)?")


class Step(NamedTuple):
    """A command of the tutorial, and the output lines that the tutorial shows."""

    command: str
    shown: list[str]


def steps() -> Iterator[Step]:
    step = None
    for language, text in fences(PAGE):
        if language == "sh":
            (command,) = text.splitlines()
            step = Step(command, [])
            yield step
        elif language == "text" and step is not None:
            step.shown.extend(text.splitlines())


def steps_of(program: str, *commands: str) -> list[Step]:
    words = [(step, shlex.split(step.command)) for step in list(steps())]
    return [step for step, (first, second, *_) in words if first == program and second in commands]


def program_of(step: Step) -> list[str]:
    return [sys.executable, "-m", "cosim.cli", *shlex.split(step.command)[1:]]


def shape(line: str) -> str:
    """Return the line without numbers and spaces: the column width depends on the numbers."""
    return "".join(NUMBER.sub("0", line).split())


def numbers(line: str) -> list[float]:
    return [float(match[0].strip(".").replace(",", "")) for match in NUMBER.finditer(line)]


def alike(line: str, other: str) -> bool:
    """Whether two output lines agree to 2 %, or both differ from zero by rounding only."""
    return shape(line) == shape(other) and numbers(line) == pytest.approx(numbers(other), rel=0.02, abs=1e-12)


def write_files(folder: Path) -> None:
    """Write the files that the tutorial shows."""
    for language, text in fences(PAGE):
        if language == "toml" and (named := re.match(r"# (\w+\.toml)\n", text)):
            (folder / named[1]).write_text(text)


STILL = steps_of("noack", "check", "simulate", "certify")
MAKE = [step for step in steps() if step.command.startswith("make ")]
LIVE = steps_of("noack", "run", "set")
