"""The committed page: its text is the template's, its numbers are computed by the code."""

import json
import math
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cosim.cli import app, command
from cosim.studies.campaign.campaign_file import load
from cosim.studies.paper import paper_page
from cosim.studies.paper.paper_page import number, render

ROOT = Path(__file__).parents[4]
COMMITTED = json.loads((ROOT / "docs" / "figures" / "paper.json").read_bytes())


def test_the_page_is_the_template_with_the_committed_numbers() -> None:
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    assert text == render(COMMITTED)
    for name in re.findall(r"figures/[\w.-]+", text):
        assert (ROOT / "docs" / name).stat().st_size > 1000


def test_the_committed_campaign_is_complete() -> None:
    campaign, summary = load(ROOT / "campaigns" / "paper.toml"), COMMITTED["summary"]
    assert summary["draws"] == campaign.draws >= 1000
    assert len(summary["points"]) == math.prod(len(axis.labels) for axis in campaign.axes)
    assert [claim["says"] for claim in summary["claims"]] == [one.says for one in campaign.claims]


def test_the_command_runs_the_campaign_and_writes_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "cores", lambda: 1)
    monkeypatch.setattr(command, "DEFAULT_RUNS", tmp_path / "runs")
    # test_evidence.py computes it
    monkeypatch.setattr(paper_page, "evidence", lambda *_: COMMITTED["evidence"])
    done = CliRunner().invoke(app, ["paper", "--draws", "5", "--out", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["draws"] == 5
    assert all(Path(file).is_file() for file in report["files"])
    assert (tmp_path / "runs" / "campaigns" / "paper" / "campaign.html").is_file()
    written = json.loads((tmp_path / "figures" / "paper.json").read_bytes())
    assert (tmp_path / "paper.md").read_text(encoding="utf-8") == render(written)
    assert 0 <= written["representative"] < 5


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (517.0, "517"), (1234.5, "1,230"), (158921.0, "158,921"), (-0.25, "−0.25"),
        (0.0328, "0.0328"), (1e-12, "10⁻¹²"), (2.83e33, "2.83 · 10³³"), (None, "∞"),
    ],
)  # fmt: skip
def test_numbers_are_rounded_for_reading(value: float | None, text: str) -> None:
    assert number(value) == text


def test_a_folder_that_cannot_be_written_gives_one_line_before_any_simulation(
    tmp_path: Path,
) -> None:
    (tmp_path / "file").touch()
    blocked = CliRunner().invoke(app, ["paper", "--out", str(tmp_path / "file")])
    assert blocked.exit_code == 1
    assert blocked.stderr.count("\n") == 1
