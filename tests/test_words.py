"""Phrases that a reader from the field stumbled over do not come back."""

import subprocess
from pathlib import Path

from cosim.output.page_kit import glossary
from tests.pages import ROOT

PHRASES = (
    "lost that nobody ordered", "lost outside the emulator", "in the long run, at most",
    "unexplained, RMS", "what this run says of them", "look at it", "the trigger watches",
    "decays at any rate below", "some coincide", "stops listening",
    "makes an ‖e_s‖ of", "presupposed", "reproduce themselves",
    "the plant feels", "minus the same draw", "nothing is done", "no run goes on",
    "did not live to see", "did not come to the start", "holds nothing", "takes one away",
    "nobody's interface", "never parts from", "in your hands", "begins with nothing",
    "of who runs it", "where nobody looks", "s a leg", "no update missing",
    "updates outstanding", "× the scenario's", "certified for the missing",
    "certified from the newest", "largest certified value of each quantity",
    "that must pass enters", "100 % is normal", "so often\"",
    "how far the run came", "that confirms itself", "has made of it", "asks for no lines",
    "has the last word", "says what follows from what",
)  # fmt: skip
"""The left columns of the project's list of words, as far as they are unambiguous."""
PLACES = ("cosim", "noack", "netem", "plant_server", "sensor_node", "controller_node")


def texts() -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", *PLACES, "docs/*.md", "README.md"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    names = listed.stdout.splitlines()
    return [ROOT / name for name in names if name.endswith((".py", ".jinja", ".md", ".toml"))]


def test_no_phrase_of_the_list_is_left() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {phrase}"
        for path in texts()
        if path.is_file()
        for phrase in PHRASES
        if phrase in path.read_text(encoding="utf-8")
    ]
    assert found == []


def test_the_glossary_of_the_documentation_is_that_of_the_program() -> None:
    assert glossary() in (ROOT / "docs/glossary.md").read_text(encoding="utf-8")
