"""What people read, against approved texts: ``APPROVE=1 pytest`` writes them anew.

A difference is a change of the output: look at it before you approve it.
"""

import os
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

import noack
from cosim.cli import app
from tests.cosim.output.test_page import Page

APPROVED = Path(__file__).with_name("approved")
_STARTED = re.compile(r"started [\w:+-]+")
_ROUNDING = re.compile(r"[ \d]\d?\.?\d*e-(0[7-9]|1\d)")
"""Differences of rounding, which depend on the processor."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's example in virtual time: the same bits everywhere."""
    return noack.simulate("lane_following", runs=tmp_path_factory.mktemp("runs")).directory


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("summary", ["summary", "RUN"]),
        ("summary-verbose", ["summary", "RUN", "--verbose"]),
        ("fidelity", ["fidelity", "RUN"]),
        ("certify", ["certify", "lane_following"]),
        ("certify-unlimited", ["certify", "lane_weighted", "--set", "network.enforce_mansd=false"]),
        ("margin", ["margin", "lane_periodic", "--most", "3", "--no-period"]),
    ],
)
def test_the_terminal_shows_what_was_approved(
    name: str, words: list[str], run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.argv", ["noack"])
    done = CliRunner().invoke(app, [str(run) if word == "RUN" else word for word in words])
    assert done.exit_code == 0, done.output
    compare(f"{name}.txt", done.stdout.replace(str(run), "RUN"))


def test_the_report_shows_what_was_approved(run: Path) -> None:
    page = Page(noack.open_run(run).report().read_text(encoding="utf-8"))
    _, _, body = page.text.rpartition("}\n")  # without the style
    text, _, _ = body.partition("Scenario and environment")
    compare("report.txt", "\n".join(line for line in text.splitlines() if line.strip()))


def compare(name: str, text: str) -> None:
    text = _ROUNDING.sub(" tiny", _STARTED.sub("started …", text)).rstrip() + "\n"
    if os.environ.get("APPROVE"):
        (APPROVED / name).write_text(text, encoding="utf-8")
    assert text == (APPROVED / name).read_text(encoding="utf-8")
