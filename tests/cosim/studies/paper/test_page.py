"""The committed page: its text is the template's, its numbers are computed by the code."""

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cosim.cli import app
from cosim.studies.campaign.campaign_workers import alone
from cosim.studies.campaign.draw_statistics import paired, quartiles
from cosim.studies.paper.paper_campaign import (
    BASE,
    COLUMNS,
    EnsemblePart,
    PaperWork,
    load_campaign,
    parts,
    run_parts,
)
from cosim.studies.paper.paper_claims import PaperVerdict, claims, judge
from cosim.studies.paper.paper_evidence import evidence
from cosim.studies.paper.paper_figures import ensemble_figure
from cosim.studies.paper.paper_numbers import HORIZON_S, number, percent, spread
from cosim.studies.paper.paper_page import render
from cosim.studies.paper.paper_results import REPRESENTED, Results, dumps, load_results, results_of

ROOT = Path(__file__).parents[4]
CAMPAIGN, SCENARIOS = load_campaign()
VARIATIONS = tuple(SCENARIOS)
COMMITTED = ROOT / "docs" / "figures" / "paper.json"
DIGITS = 2e-4
"""Five digits are stored; rounding, which a loop may amplify by 1e5, is far below."""


@pytest.fixture(scope="module")
def results() -> Results:
    return load_results(COMMITTED)


def test_the_page_is_the_template_with_the_committed_numbers(results: Results) -> None:
    assert (ROOT / "docs" / "paper.md").read_text(encoding="utf-8") == render(results)
    assert dumps(results) == COMMITTED.read_text(encoding="utf-8")


def test_the_ensemble_is_complete(results: Results) -> None:
    assert results.count() >= 1000
    found = {key: len(rows) for key, rows in results.tables.items()}
    assert found == {(p.table, p.variation): p.draws for p in parts(results.count(), VARIATIONS)}


@pytest.mark.parametrize("part", parts(1000, VARIATIONS), ids=lambda p: f"{p.table}-{p.variation}")
def test_the_committed_draws_are_what_the_code_computes(
    results: Results, part: EnsemblePart
) -> None:
    last = results.count(part.variation, part.table) - 1
    computed = PaperWork(part.table, SCENARIOS[part.variation]).run(range(last, last + 1))
    rows = results.tables[part.table, part.variation]
    np.testing.assert_allclose(rows[[last]], computed, rtol=DIGITS, atol=1e-12)


def test_the_committed_evidence_is_what_the_code_computes(results: Results) -> None:
    computed = results_of([], evidence(SCENARIOS[BASE], results.representative)).evidence
    assert_close(computed, results.evidence)


def assert_close(first: Any, second: Any) -> None:
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_close(first[key], second[key])
    elif isinstance(first, list):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_close(one, other)
    else:
        assert first == pytest.approx(second, rel=DIGITS, abs=1e-9)


def test_the_page_shows_files_that_exist(results: Results) -> None:
    text = render(results)
    for name in ("paper-mb-et.svg", "paper-zoh-et.svg", "paper-ensemble.png", "paper.json"):
        assert f"figures/{name}" in text
        assert (ROOT / "docs" / "figures" / name).stat().st_size > 1000


def with_column(results: Results, name: str, values: Any, variation: str = BASE) -> Results:
    table = results.tables["draws", variation].copy()
    table[:, COLUMNS["draws"].index(name)] = values
    return Results({**results.tables, ("draws", variation): table}, results.evidence)


def test_verdicts_follow_from_the_draws(results: Results) -> None:
    """A claim that the draws contradict is not confirmed; one that most draws confirm is partly."""
    gist = "With ZOH the number of updates increases."

    def verdict(changed: Results) -> PaperVerdict:
        return next(claim.verdict for claim in claims(changed) if claim.gist == gist)

    events, some = results.column("zoh.events"), np.arange(results.count()) % 10
    assert verdict(results) == PaperVerdict.CONFIRMED
    assert verdict(with_column(results, "zoh.events", 1)) == PaperVerdict.NOT_CONFIRMED
    most = np.where(some < 6, events, 1)
    assert verdict(with_column(results, "zoh.events", most)) == PaperVerdict.PARTLY
    # A variation of an unspecified detail counts; one that departs from the paper's example does
    # not.
    assert verdict(with_column(results, "zoh.events", 1, "x(0) × 10")) == PaperVerdict.PARTLY
    assert verdict(with_column(results, "zoh.events", 1, "box × 5")) == PaperVerdict.CONFIRMED


def test_a_loop_that_never_settles_confirms_no_claim(results: Results) -> None:
    never = with_column(results, "model.settled_1_s", math.inf)
    (claim,) = [c for c in claims(never) if c.gist == "MB-ET stabilises the uncertain system."]
    assert claim.verdict == PaperVerdict.NOT_CONFIRMED
    assert "> 40" in render(never)


def test_an_inter_event_time_below_the_certified_one_is_reported(results: Results) -> None:
    short = with_column(results, "model.gap_min_s", 1e-3)
    (claim,) = [c for c in claims(short) if "minimum inter-event" in c.gist]
    assert claim.verdict == PaperVerdict.NOT_CONFIRMED


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
    assert SCENARIOS[BASE].horizon_s == HORIZON_S


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
    assert ensemble_figure(with_column(results, "zoh.settled_5_s", some)).axes


def test_the_command_writes_the_page_that_the_code_computes(tmp_path: Path) -> None:
    # In its own process, which starts others.
    done = subprocess.run(
        [sys.executable, "-m", "cosim.cli", "paper", "--draws", "4", "--out", tmp_path, "--json"],
        capture_output=True, text=True, check=False, timeout=600, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["draws"] == 4
    assert all(Path(file).is_file() for file in told["files"])
    written = load_results(tmp_path / "figures" / "paper.json")
    assert (tmp_path / "paper.md").read_text(encoding="utf-8") == render(written)
    # Computed in other processes, with the same numbers.
    here = results_of(run_parts({BASE: SCENARIOS[BASE]}, 4, alone), {})
    for part in parts(4, (BASE,)):
        key = (part.table, part.variation)
        np.testing.assert_array_equal(written.tables[key], here.tables[key])


def test_mistakes_give_one_line_before_any_simulation(tmp_path: Path) -> None:
    few = CliRunner().invoke(app, ["paper", "--draws", "1", "--out", str(tmp_path)])
    assert few.exit_code == 2
    assert few.stderr.count("\n") == 1
    assert "at least 4 draws" in few.stderr
    (tmp_path / "file").touch()
    blocked = CliRunner().invoke(app, ["paper", "--out", str(tmp_path / "file")])
    assert blocked.exit_code == 1
    assert blocked.stderr.count("\n") == 1
