"""The committed page: its text is the template's, its numbers are computed by the code."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from cosim.cli import app, command
from cosim.output.figure_drawing import draw
from cosim.studies.campaign.metrics import paired, quartiles
from cosim.studies.paper import paper_run
from cosim.studies.paper.paper_campaign import BASE, COLUMNS, load_campaign, parts
from cosim.studies.paper.paper_claims import PaperVerdict, claims, judge
from cosim.studies.paper.paper_figures import ensemble_figure
from cosim.studies.paper.paper_page import render
from cosim.studies.paper.paper_results import (
    HORIZON_S,
    REPRESENTED,
    Results,
    dumps,
    number,
    percent,
    read_results,
    spread,
)
from noack.config.scenario import Scenario

ROOT = Path(__file__).parents[4]
COMMITTED = ROOT / "docs" / "figures" / "paper.json"
DIGITS = 2e-4
"""Five digits are stored; rounding, which a loop may amplify by 1e5, is far below."""
DRAWS = 4


@pytest.fixture(scope="module")
def results() -> Results:
    return read_results(json.loads(COMMITTED.read_bytes()))


def test_the_page_is_the_template_with_the_committed_numbers(results: Results) -> None:
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    assert text == render(results)
    assert dumps(results) == COMMITTED.read_text(encoding="utf-8")
    for name in ("paper-mb-et.svg", "paper-zoh-et.svg", "paper-ensemble.png", "paper.json"):
        assert f"figures/{name}" in text
        assert (ROOT / "docs" / "figures" / name).stat().st_size > 1000


def test_the_ensemble_is_complete(results: Results) -> None:
    assert results.count() >= 1000
    found = {key: len(rows) for key, rows in results.tables.items()}
    wanted = parts(results.count(), tuple(load_campaign()[1]))
    assert found == {(part.table, part.variation): part.draws for part in wanted}


def test_the_command_computes_the_committed_draws_and_writes_the_page(
    results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def evidence(scenario: Scenario, representative: int) -> Any:
        assert scenario == load_campaign()[1][BASE]
        assert 0 <= representative < DRAWS
        return results.evidence  # test_evidence.py computes it

    monkeypatch.setattr(command, "cores", lambda: 1)
    monkeypatch.setattr(paper_run, "evidence", evidence)
    words = ["paper", "--draws", str(DRAWS), "--out", str(tmp_path), "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["draws"] == DRAWS
    assert len(report["files"]) == 5
    assert all(Path(file).is_file() for file in report["files"])
    console = Console(record=True, width=200)
    paper_run.print_claims(console, report)
    text = console.export_text()
    assert f"Section V over {DRAWS} draws" in text
    assert all(claim["gist"] in text and claim["verdict"] in text for claim in report["claims"])
    written = read_results(json.loads((tmp_path / "figures" / "paper.json").read_bytes()))
    assert (tmp_path / "paper.md").read_text(encoding="utf-8") == render(written)
    for key, rows in results.tables.items():
        found = written.tables[key]
        np.testing.assert_allclose(found, rows[: len(found)], rtol=DIGITS, atol=1e-12)


def with_column(results: Results, name: str, values: Any, variation: str = BASE) -> Results:
    table = results.tables["draws", variation].copy()
    table[:, COLUMNS["draws"].index(name)] = values
    return Results({**results.tables, ("draws", variation): table}, results.evidence)


@pytest.mark.parametrize(
    ("column", "values", "variation", "verdict"),
    [
        ("zoh.events", None, BASE, PaperVerdict.CONFIRMED),
        ("zoh.events", 1, BASE, PaperVerdict.NOT_CONFIRMED),
        ("zoh.events", "some", BASE, PaperVerdict.PARTLY),
        # A variation of an unspecified detail counts; another example does not.
        ("zoh.events", 1, "x(0) × 10", PaperVerdict.PARTLY),
        ("zoh.events", 1, "box × 5", PaperVerdict.CONFIRMED),
        ("model.settled_1_s", math.inf, BASE, PaperVerdict.NOT_CONFIRMED),
        ("model.gap_min_s", 1e-3, BASE, PaperVerdict.NOT_CONFIRMED),  # below the certified one
    ],
)
def test_verdicts_follow_from_the_draws(
    results: Results, column: str, values: Any, variation: str, verdict: PaperVerdict
) -> None:
    gist = {
        "zoh.events": "With ZOH the number of updates increases.",
        "model.settled_1_s": "MB-ET stabilises the uncertain system.",
        "model.gap_min_s": "A positive minimum inter-event time exists.",
    }
    before = results.column(column, variation)
    if values == "some":
        values = np.where(np.arange(len(before)) % 10 < 6, before, 1)
    changed = with_column(results, column, before if values is None else values, variation)
    assert [c.verdict for c in claims(changed) if c.gist == gist[column]] == [verdict]
    assert values is not math.inf or "> 40" in render(changed)


def test_the_least_favourable_variation_is_named(results: Results) -> None:
    found = judge(results, lambda c: c("model.deliveries") < 0.5 * c("model.events"))
    assert found.least_in == "Bernoulli 0.5"
    assert found.verdict == PaperVerdict.PARTLY


def test_the_representative_draw_is_nearest_to_the_medians(results: Results) -> None:
    values = np.array([results.column(name) for name in REPRESENTED])
    low, middle, high = np.array([quartiles(row) for row in values]).T[:, :, None]
    distance = (((values - middle) / (high - low)) ** 2).sum(axis=0)
    assert distance[results.representative] == distance.min()


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (517.0, "517"), (1234.5, "1,230"), (158921.0, "158,921"), (-0.25, "−0.25"),
        (0.0328, "0.0328"), (1e-12, "10⁻¹²"), (2.83e33, "2.83 · 10³³"), (math.inf, "> 40"),
    ],
)  # fmt: skip
def test_numbers_are_rounded_for_reading(value: float, text: str) -> None:
    assert number(value) == text
    assert load_campaign()[1][BASE].horizon_s == HORIZON_S


def test_a_share_is_100_percent_only_if_it_is_complete() -> None:
    assert [percent(s) for s in (1.0, 0.999, 0.75, 0.004, 0.0)] == [
        "100 %", "99.9 %", "75 %", "0.4 %", "0 %",
    ]  # fmt: skip


def test_quartiles_are_values_of_draws_and_may_be_infinite() -> None:
    values = np.array([4.0, 1.0, math.inf, 2.0, 3.0, math.inf, math.inf, math.inf])
    assert quartiles(values) == (2.0, 4.0, math.inf)
    assert spread(values) == "4 (2 … > 40)"
    never = np.array([math.inf, 1.0])
    assert paired(np.array([math.inf, math.inf]), never).tolist() == [0.0, math.inf]


def test_a_figure_with_draws_that_never_settle_can_be_drawn(results: Results) -> None:
    some = np.where(np.arange(results.count()) % 2, math.inf, 10.0)
    assert draw(ensemble_figure(with_column(results, "zoh.settled_5_s", some))).axes


def test_mistakes_give_one_line_before_any_simulation(tmp_path: Path) -> None:
    few = CliRunner().invoke(app, ["paper", "--draws", "1", "--out", str(tmp_path)])
    assert few.exit_code == 2
    assert few.stderr.count("\n") == 1
    assert "at least 4 draws" in few.stderr
    (tmp_path / "file").touch()
    blocked = CliRunner().invoke(app, ["paper", "--out", str(tmp_path / "file")])
    assert blocked.exit_code == 1
    assert blocked.stderr.count("\n") == 1
