"""Texts that people read, against approved files.

``APPROVE=1 pytest`` writes them anew: read the difference.
"""

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from netem.core.errors import NoackError

_OUTPUTS = Path(__file__).parents[1] / "cosim" / "output" / "approved"
_STARTED = re.compile(r"started [\w:+-]+")
_ROUNDING = re.compile(r"[ \d]\d?\.?\d*e-(0[7-9]|1\d)")
"""Differences of rounding, which depend on the processor."""


def compare_text(path: Path, text: str) -> None:
    """Compare a text with the approved one."""
    if os.environ.get("APPROVE"):
        path.write_text(text, encoding="utf-8")
    assert text == path.read_text(encoding="utf-8")


def compare_output(name: str, text: str) -> None:
    """Compare a text of noack with the approved one, except for start times and rounding errors."""
    text = _ROUNDING.sub(" tiny", _STARTED.sub("started …", text)).rstrip() + "\n"
    compare_text(_OUTPUTS / name, text)


def compare_lines(path: Path, lines_of: Callable[[str], Sequence[str]]) -> None:
    """Compare the lines that each input of a file gives with the approved ones.

    An input is a line of its own, and what it gives is indented below it; ``#`` begins a heading.
    """
    lines: list[str] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("    "):
            continue
        lines.append(line)
        if not line.startswith("#"):
            lines += [f"    {output_line}" for output_line in lines_of(line)]
    compare_text(path, "\n".join(lines) + "\n")


def lines_of_error(call: Callable[[], object], **paths: Path) -> list[str]:
    """The lines of the error that a call raises, with the names of files and folders replaced."""
    with pytest.raises(NoackError) as error:
        call()
    text = str(error.value)
    for name, path in paths.items():
        text = text.replace(str(path), name)
    return text.splitlines()
