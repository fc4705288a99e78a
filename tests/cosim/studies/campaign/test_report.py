"""The output of a campaign: metrics, certificates, figures, the page and the command line."""

import json
import math
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from typer.testing import CliRunner

from cosim.cli import app
from cosim.output.figure_files import inline
from cosim.output.result_tables import ResultTable
from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS
from cosim.studies.campaign import campaign_grid
from cosim.studies.campaign.campaign_figures import (
    curve_figure,
    distribution_figure,
    heat_map_figure,
    pareto_figure,
    undominated,
)
from cosim.studies.campaign.campaign_file import load
from cosim.studies.campaign.campaign_grid import base_of
from cosim.studies.campaign.campaign_report import split_table, write_report, written
from cosim.studies.campaign.campaign_summary import summarise
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import METRICS, certified_error, estimate, measured
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load as load_scenario
from noack.scenario.scenario_file import validate
from noack.theory.certificates.conditions import ideal_conditions
from noack.theory.certificates.scenario_certificates import certify
from tests.cosim.studies.campaign.conftest import Command, Few, Write

ROOT = Path(__file__).parents[4]
HOSTILE = "</title></svg><script>alert('x')</script> & \"$\\frac{1}{2}$\""


def scalar(content: dict[str, Any], **changed: Any) -> Scenario:
    """x' = x + u, Â = 1, B̂ = 1, K = −3: the model decays like e^(−2t)."""
    content["model"] = {"A": [[1.0]], "B": [[1.0]], "gain": [[-3.0]]}
    content["plant"]["initial_state"] = [1.0]
    return resolve(validate(content | changed, "here"))


def test_a_scalar_models_certified_error_is_m_thresholds(content: dict[str, Any]) -> None:
    # e^{(−2+α)τ} ≤ 1: each of the M − 1 = 2 missed errors counts once, and so does the current one.
    assert certified_error(scalar(content)) == pytest.approx(3 * 0.5, rel=1e-6)


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [
        ("trigger", "alpha_per_s", 2.5),  # faster than the model
        ("trigger", "floor", 0.01),
        ("network", "enforce_mansd", False),
        (None, "mode", "zoh"),
    ],
)
def test_nothing_is_certified_outside_the_theorems_assumptions(
    content: dict[str, Any], table: str | None, key: str, value: Any
) -> None:
    (content if table is None else content[table])[key] = value
    assert certified_error(scalar(content)) is None


def test_the_certified_error_bounds_that_of_a_plants_own_certificate() -> None:
    for name in ("lane_following", "lane_weighted"):
        resolved = resolve(load_scenario(ROOT / "scenarios" / f"{name}.toml"))
        constants = certify(resolved, ideal_conditions(resolved)).constants
        assert constants is not None
        bound = certified_error(resolved)
        assert bound is not None
        assert bound >= constants.delta * 0.5 * (1 - 1e-9)
        assert name != "lane_weighted" or bound == pytest.approx(5 * 0.5, rel=1e-6)  # Δ = M


@pytest.mark.parametrize("failure", [DIVERGED, TOO_MANY_EVENTS])
def test_metrics_without_a_value_and_of_failed_runs_are_infinite(failure: int) -> None:
    columns = {
        "transmissions": np.array([10, 1, 1]),
        "deliveries": np.array([4, 1, 0]),
        "settling_s": np.array([1.5, math.nan, 0.1]),
        "sup_e_c_scaled": np.array([0.5, 0.25, 0.1]),
        "status": np.array([OK, OK, failure]),
    }
    found = measured(columns, 2.0)
    assert found["transmissions"].tolist() == [10.0, 1.0, math.inf]
    assert found["lost_share"].tolist() == [0.6, 0.0, math.inf]
    assert found["settling_s"].tolist() == [1.5, math.inf, math.inf]
    assert found["certificate_used"].tolist() == [0.25, 0.125, math.inf]
    assert "certificate_used" not in measured(columns, None)


def test_a_summary_covers_all_draws_and_pairs_them(full: Store, campaign: Few) -> None:
    summary = summarise(campaign[0], full)
    rows = [point.work.run(range(7)) for point in campaign[1]]
    for found, row in zip(summary.found, rows, strict=True):
        assert found.estimates["cost"].mean == pytest.approx(row["cost"].mean(), rel=1e-12)
        assert found.ended == {"finished": 7}
    assert ["certificate_used" in found.estimates for found in summary.found] == [
        True, True, False, False
    ]  # fmt: skip
    assert summary.breaches == 0
    assert [(c.point.number, c.reference.number) for c in summary.compared] == [(0, 2), (1, 3)]
    differences = (rows[0]["transmissions"] - rows[2]["transmissions"]).astype(float)
    assert summary.compared[0].differences["transmissions"].estimate == estimate(differences)
    assert differences.std() < rows[2]["transmissions"].std() or differences.mean() < 0


def test_an_exceeded_certificate_is_reported_in_every_output(
    write: Write, plan: dict[str, Any], tmp_path: Path, run_command: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(campaign_grid, "certified_error", lambda resolved: 1e-3)
    done = run_command(write(plan, figures=[]))
    assert done.exit_code == 1
    assert "28 of 28 runs exceed a certified bound." in done.output
    assert 'class="verdict bad"' in (tmp_path / "out" / "campaign.html").read_text()


def test_the_command_writes_the_reported_files_and_keeps_complete_chunks(
    write: Write, plan: dict[str, Any], tmp_path: Path, run_command: Command
) -> None:
    path = write(plan, figures=[])
    done = run_command(path, "--json", "--draws", "4")
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report.pop("made") == 16
    assert all(Path(file).exists() for file in report.pop("files"))
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == report
    done = run_command(path, "--json", "--tables", str(tmp_path / "tables"))
    assert json.loads(done.stdout)["made"] == 4 * (7 - 3)
    names = {file.name for file in (tmp_path / "tables").iterdir()}
    assert names == {"campaign.csv", "campaign.tex", "differences.csv", "differences.tex"}
    rows = (tmp_path / "tables/campaign.csv").read_text().splitlines()
    assert len(rows) == 1 + 4
    assert "transmissions" in rows[0]


def test_a_missing_campaign_gives_one_line() -> None:
    done = CliRunner().invoke(app, ["campaign", "mb_vs_zho"])
    assert done.exit_code == 2
    assert done.stderr == (
        "noack: mb_vs_zho: no such file, nor a shipped campaign; did you mean mb_vs_zoh?\n"
    )


def test_the_page_is_one_file_and_escapes_user_text(
    write: Write, plan: dict[str, Any], full: Store
) -> None:
    plan["axes"][1]["title"] = HOSTILE
    path = write(plan, description=HOSTILE)
    campaign = load(path)
    summary = summarise(campaign, full)
    write_report(summary, full, base_of(campaign, path)[1])
    html = (full.folder / "campaign.html").read_text(encoding="utf-8")
    assert "<script" not in html
    assert "http" not in html.replace('"http-equiv', "").replace("http-equiv=", "")
    assert html.count("Student&#39;s t") == 2  # as in docs/campaigns.md and statistics.py
    assert "(normal)" not in html
    assert html.count("<figure id=") == len(campaign.figures)
    assert html.count("<svg") == len(campaign.figures)


points = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=12)


@given(points)
def test_the_front_is_what_nothing_dominates(drawn: list[tuple[int, int]]) -> None:
    x, y = np.array(drawn, dtype=float).T
    front = {(x[i], y[i]) for i in undominated(x, y)}
    expected = {
        (a, b) for a, b in drawn
        if not any((c <= a and d <= b) and (c, d) != (a, b) for c, d in drawn)
    }  # fmt: skip
    assert front == expected
    assert len(undominated(x, y)) == len(expected)
    assert (np.diff(x[undominated(x, y)]) > 0).all()


def test_figures_accept_infinite_single_and_many_values() -> None:
    never, one = estimate(np.full(4, math.inf)), estimate(np.array([2.0]))
    many = estimate(np.geomspace(1e-9, 1e9, 50))
    drawn = []
    for values in ([never], [never, one, many]):
        labels = [str(i) for i in range(len(values))]
        series = {f"series {i}": values for i in range(12)}
        pairs = {name: (values, list(reversed(values))) for name in series}
        drawn += [
            pareto_figure(pairs, "transmissions", "cost"),
            curve_figure(None, labels, series, HOSTILE, "cost"),
        ]
    drawn.append(curve_figure(np.array([1.0]), ["1"], {"a": [one]}, "x", "settling_s"))
    for matrix in (np.full((2, 3), np.nan), np.array([[1.0, np.nan, 1e9]])):
        rows = (("x", ["a", "b", "c"]), ("y", ["d", "e"][: len(matrix)]))
        drawn.append(heat_map_figure({f"map {i}": matrix for i in range(4)}, *rows, "cost"))
    values = {"a": np.full(3, math.inf), "b": np.array([1.0]), "c": np.geomspace(1e-3, 1e3, 9)}
    drawn.append(distribution_figure(values, "cost"))
    for figure in drawn:
        assert inline(figure).startswith("<svg")


def test_numbers_are_written_with_their_interval() -> None:
    assert written(estimate(np.array([1.0, 3.0]))) == "2 ± 13"
    assert written(estimate(np.array([-1.0, math.inf]))) == "−1 (50 % of runs)"
    assert written(estimate(np.array([math.inf]))) == "never"
    assert set(METRICS) >= {"cost", "settling_s"}


def test_terminal_tables_print_names_literally_and_list_failed_runs(
    write: Write, plan: dict[str, Any], run_command: Command
) -> None:
    name = "[/x] [red]"
    plan["axes"][0]["variants"] = {name: {"mode": "model"}, "ZOH": {"mode": "zoh"}}
    plan["axes"][1]["title"] = "[/b]"
    result = run_command(write(plan, figures=[], draws=2, metrics={"most_events": 1}))
    assert result.exit_code == 0, result.output
    assert name in result.stdout
    assert "[/b]" in result.stdout
    text = " ".join(result.stdout.split())
    assert f"At policy {name}, beta 0.1 not all runs reached the horizon: 2 too many" in text
    assert "continuous time: the trigger acts at once and the network has no delay" in text


@pytest.mark.parametrize("width", [45, 60, 88, 89, 119])
def test_the_tables_fit_narrow_terminals(width: int) -> None:
    headings = ["transmissions", "shortest interval [s]", "cost", "settling time [s]"]
    rows = [
        ["MB-ET", "0.1", "36 ± 16", "0.159 ± 0.016", "12 ± 16", "11.2 ± 8.4 (97.5 % of runs)"],
        ["ZOH-ET", "10", "549 ± 44", "0.0310 ± 0.0039", "never", "–"],
    ]
    console = Console(width=width, file=StringIO(), record=True)
    whole = ResultTable("all", "all", ["policy", "β", *headings], rows)
    for table in split_table(whole, 2, width):
        console.print(table)
    lines = console.export_text().splitlines()
    for label in ("MB-ET", "ZOH-ET"):
        found = [line for line in lines if line.strip().startswith(label)]
        (row,) = [row for row in rows if row[0] == label]
        for cell in row[2:]:
            assert sum(cell in line for line in found) == 1
    for heading in headings:
        assert all(any(word in line for line in lines) for word in heading.split())
    assert all(len(line) <= width for line in lines)
    assert (len(found) == 1) == (width > 88)
