"""What people read, against approved texts.

``APPROVE=1 pytest`` writes the approved texts anew.
"""

from pathlib import Path

import pytest

import noack
from tests.cosim.output.parsed_page import Page
from tests.helpers.approved import compare_output
from tests.helpers.command_line import invoke

pytestmark = pytest.mark.usefixtures("nothing_was_found_before")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> noack.Run:
    """The paper's example in virtual time: the same bits everywhere."""
    return noack.simulate("lane_following", runs=tmp_path_factory.mktemp("runs"))


@pytest.fixture
def run(simulated: noack.Run) -> Path:
    return simulated.directory


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("summary", ["summary", "RUN"]),
        ("summary-verbose", ["summary", "RUN", "--verbose"]),
        ("certify", ["certify", "lane_following", "--no-search"]),
        ("certify-verbose", ["certify", "lane_following", "--no-search", "--verbose"]),
        ("margin", ["margin", "lane_periodic", "--most", "3", "--no-period"]),
    ],
)  # fmt: skip
def test_the_terminal_shows_what_was_approved(
    name: str, words: list[str], run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.argv", ["noack"])
    result = invoke(*(run if word == "RUN" else word for word in words))
    assert result.exit_code == 0, result.output
    compare_output(f"{name}.txt", result.stdout.replace(str(run), "RUN"))


@pytest.mark.usefixtures("no_drawing")
def test_the_report_shows_what_was_approved(simulated: noack.Run) -> None:
    page = Page(simulated.report().read_text(encoding="utf-8"))
    _, _, body = page.text.rpartition("}\n")  # without the style
    text, _, _ = body.partition("Scenario and environment")
    compare_output("report.txt", "\n".join(line for line in text.splitlines() if line.strip()))
