"""The output of a campaign: the page, the written files and the command line."""

import json
from pathlib import Path
from typing import Any

import pytest

from cosim.studies.campaign import campaign_grid
from cosim.studies.campaign.campaign_file import load
from cosim.studies.campaign.campaign_grid import base_of, grid
from cosim.studies.campaign.campaign_report import write_report
from cosim.studies.campaign.campaign_summary import summarise
from cosim.studies.campaign.chunk_store import Store
from netem.output.result_tables import ResultTable
from netem.output.terminal_writer import without_constants
from tests.cosim.studies.campaign.conftest import HOSTILE, Command, Write


def test_an_exceeded_certificate_is_reported_in_every_output(
    write: Write, plan: dict[str, Any], tmp_path: Path, run_command: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(campaign_grid, "certified_error", lambda resolved: 1e-3)
    result = run_command(write(plan, figures=[]))
    assert result.exit_code == 1
    assert "28 of 28 runs exceed a certified bound." in result.output
    assert 'class="verdict bad"' in (tmp_path / "out" / "campaign.html").read_text()


def test_the_command_writes_the_reported_files_and_keeps_complete_chunks(
    write: Write, plan: dict[str, Any], tmp_path: Path, run_command: Command
) -> None:
    path = write(plan, figures=[])
    result = run_command(path, "--json", "--draws", "4")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report.pop("made") == 16
    assert all(Path(file).exists() for file in report.pop("files"))
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == report
    result = run_command(path, "--json", "--tables", str(tmp_path / "tables"))
    assert json.loads(result.stdout)["made"] == 4 * (7 - 3)
    names = {file.name for file in (tmp_path / "tables").iterdir()}
    assert names == {"campaign.csv", "differences.csv"}
    rows = (tmp_path / "tables/campaign.csv").read_text().splitlines()
    assert len(rows) == 1 + 4
    assert "transmissions" in rows[0]
    assert "draws" not in result.stderr
    result = run_command(path, "--json", "--draws", "4")  # of which page and summary then are
    assert json.loads(result.stdout)["made"] == 0
    assert "all other runs are kept, and a larger --draws shows them again" in result.stderr


@pytest.mark.parametrize("path", sorted(Path("campaigns").glob("*.toml")), ids=lambda path: path.stem)
@pytest.mark.usefixtures("no_drawing")
def test_every_shipped_campaign_is_summarised(path: Path, run_command: Command) -> None:
    """Also where policies with matrices as norms are compared."""
    result = run_command(path, "--json", "--draws", "2")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["points"]


def test_the_page_is_one_file_and_escapes_user_text(write: Write, plan: dict[str, Any], full: Store) -> None:
    plan["axes"][1]["title"] = HOSTILE
    path = write(plan, description=HOSTILE)
    campaign = load(path)
    summary = summarise(campaign, full)
    write_report(summary, full, base_of(campaign, path)[1])
    html = (full.folder / "campaign.html").read_text(encoding="utf-8")
    assert "<script" not in html
    assert "http" not in html.replace('"http-equiv', "").replace("http-equiv=", "")
    assert html.count("<figure id=") == len(campaign.figures)
    assert html.count("<svg") == 2 * len(campaign.figures)  # for wide and narrow screens


def test_columns_that_are_the_same_at_all_points_are_named_once() -> None:
    rows = [("MB", "0.1", "3 ± 1", "–"), ("MB", "0.5", "4 ± 1", "–")]
    full = ResultTable("campaign", "c", ("policy", "β", "cost", "bound used"), rows)
    table, names = without_constants(full, 2)
    assert (table.caption, names) == ("c; everywhere policy MB, bound used –", 1)
    assert (table.headings, table.rows) == (["β", "cost"], [["0.1", "3 ± 1"], ["0.5", "4 ± 1"]])
    only_labels = full._replace(rows=[("MB", "0.1", "3", "–"), ("MB", "0.5", "3", "–")])
    for unchanged in (full._replace(rows=rows[:1]), only_labels, full._replace(rows=[])):
        assert without_constants(unchanged, 2) == (unchanged, 2)


def test_a_sampled_campaign_takes_the_later_tick_and_says_so(
    write: Write, plan: dict[str, Any], run_command: Command
) -> None:
    settings = {"controller.phase": 0.0}
    path = write(plan, time="sampled", settings=settings, figures=[], draws=2)
    result = run_command(path)
    text = " ".join(result.stdout.split())
    assert result.exit_code == 0
    assert "at 4 of 4 grid points, an update may arrive at a tick of the controller" in text
    points = grid(load(path), path)
    assert all(point.scenario.network.impairments for point in points)
