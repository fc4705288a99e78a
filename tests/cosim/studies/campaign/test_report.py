"""The output of a campaign: metrics, certificates, figures, the page and the command line."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import t as student

from cosim.output.figures.figure_description import Band
from cosim.output.figures.figure_files import inline
from cosim.output.result_tables import ResultTable
from cosim.shipped_files import find_shipped
from cosim.simulation.exact_simulation import DIVERGED, OK, TOO_MANY_EVENTS
from cosim.studies.campaign import campaign_grid
from cosim.studies.campaign.campaign_figures import (
    _left_out,
    curve_figure,
    distribution_figure,
    heat_map_figure,
    pareto_figure,
    undominated,
)
from cosim.studies.campaign.campaign_file import CampaignAxis, load
from cosim.studies.campaign.campaign_grid import Point, base_of
from cosim.studies.campaign.campaign_report import without_constants, write_report, written
from cosim.studies.campaign.campaign_summary import JudgedClaim, judge_claims, summarise
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import (
    Metric,
    burst_frequency,
    certified_error,
    difference,
    estimate,
    interval_ranks,
    measured,
)
from noack.core.linear_systems import Vector
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load as load_scenario
from noack.scenario.scenario_file import validate
from noack.theory.certificates.conditions import ideal_conditions
from noack.theory.certificates.scenario_certificates import certify
from tests.cosim.studies.campaign.conftest import Command, Few, Write, few_of
from tests.helpers.approved import compare_lines, lines_of_error

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
    content["trigger"]["alpha_per_s"] = 2.5  # faster than the model
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
    for found, row in zip(summary.results, rows, strict=True):
        assert found.estimates["cost"].mean == pytest.approx(row["cost"].mean(), rel=1e-12)
        assert found.ended == {"finished": 7}
    assert ["certificate_used" in found.estimates for found in summary.results] == [
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


def test_figures_and_texts_accept_infinite_single_and_many_values() -> None:
    never, one = estimate(np.full(4, math.inf)), estimate(np.array([2.0]))
    assert written(never) == "never"
    assert written(estimate(np.array([1.0, 3.0]))) == "2 ± 13"
    assert written(estimate(np.array([-1.0, math.inf]))) == "−1 (50 % of runs)"
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


@pytest.mark.parametrize(
    ("key", "values", "label", "logarithmic"),
    [
        ("network.impairments.0.rate_bps", (10_000, 30_000, 100_000), "rate [bit/s]", True),
        ("plant.rate_hz", (10, 20, 50, 100, 200, 500, 1000), "rate [Hz]", True),
        ("trigger.alpha_per_s", (0.1, 0.2, 0.3), "rate [1/s]", False),  # not far apart
        ("network.mansd", (1, 2, 5, 10, 15, 20), "rate", False),  # evenly
        ("network.impairments.0.delay_s", (0, 0.01, 1.0), "rate [s]", False),  # with 0
    ],
)
def test_an_axis_has_the_unit_of_its_key_and_is_logarithmic_if_its_values_grow_by_factors(
    key: str, values: tuple[float, ...], label: str, logarithmic: bool
) -> None:
    axis = CampaignAxis(name="rate", key=key, values=values)
    series = {"a": [estimate(np.ones(3)) for _ in values]}
    drawn = curve_figure(np.array(values, np.float64), axis.labels, series, axis.heading, "cost")
    assert (drawn.rows[0].panels[0].x.label, drawn.rows[0].panels[0].x.logarithmic) == (label, logarithmic)


MORE = {"says": "ZOH sends more.", "axis": "policy",
        "holds": ["transmissions @ ZOH > transmissions @ MB"]}  # fmt: skip


def judged(write: Write, plan: dict[str, Any], claim: dict[str, Any], zoh: Vector) -> JudgedClaim:
    """Judge a claim about runs with 10 transmissions of MB, and those of ZOH at β = 0.1."""
    plan["claims"] = [claim]
    campaign, points = few_of(write(plan))

    def values(point: Point) -> dict[Metric, Vector]:
        first = point.labels["policy"] == "ZOH" and point.labels["beta"] == "0.1"
        mb = np.full(len(zoh), 10.0)
        return {"transmissions": zoh if first else mb + 5 * (point.labels["policy"] == "ZOH")}

    (found,) = judge_claims(campaign, points, values)
    return found


@pytest.mark.parametrize(
    ("share", "verdict"), [(1.0, "confirmed"), (0.95, "confirmed"), (0.94, "partly"),
                           (0.5, "partly"), (0.49, "not confirmed")],
)  # fmt: skip
def test_a_verdict_follows_from_the_share_of_the_draws(
    write: Write, plan: dict[str, Any], share: float, verdict: str
) -> None:
    zoh = np.where(np.arange(100) < 100 * share, 11.0, 9.0)
    found = judged(write, plan, MORE, zoh)
    assert (found.share, found.verdict) == (share, verdict)
    assert found.least_at == "beta 0.1"
    assert "transmissions at ZOH 11" in found.medians or share <= 0.5


def test_the_least_favourable_grid_point_counts_unless_it_is_left_out(
    write: Write, plan: dict[str, Any]
) -> None:
    fewer = MORE | {"holds": ["transmissions @ ZOH < transmissions @ MB"]}
    found = judged(write, plan, fewer, np.full(4, 9.0))
    assert (found.share, found.least, found.least_at) == (1.0, 0.0, "beta 0.3")
    assert found.verdict == "partly"
    plan["claims_at"] = {"beta": [0.1]}
    assert judged(write, plan, fewer, np.full(4, 9.0)).verdict == "confirmed"


def test_a_mistake_in_a_claim_gives_the_approved_line(write: Write, plan: dict[str, Any]) -> None:
    def mistake(changed: str) -> list[str]:
        claim = {key: value for key, value in (MORE | json.loads(changed)).items() if value}
        file = write(plan | {"claims": [claim]})
        return lines_of_error(lambda: load(file), FILE=file)

    compare_lines(Path(__file__).with_name("claim_mistakes.txt"), mistake)


def test_the_interval_of_a_mean_is_the_textbooks() -> None:
    values = np.array([1.0, 2.0, 4.0, 9.0])
    found = estimate(values)
    assert found.mean == 4.0
    deviation = math.sqrt(((values - 4.0) ** 2).sum() / 3)
    assert found.halfwidth == pytest.approx(student.ppf(0.975, 3) * deviation / 2, rel=1e-12)
    assert (found.median, found.q05, found.q95, found.largest) == (2.0, 1.0, 9.0, 9.0)


def test_infinite_values_count_for_quantiles_and_not_for_the_mean() -> None:
    found = estimate(np.array([3.0, math.inf, 1.0, math.inf, math.inf]))
    assert (found.draws, found.finite, found.mean) == (5, 2, 2.0)
    assert found.median == found.largest == math.inf
    single = estimate(np.array([1.0]))
    assert single.halfwidth == single.median_high == math.inf
    assert estimate(np.arange(6.0)).median_high == 5.0  # 1 − 2 · 2⁻⁶ > 0.95
    none = estimate(np.full(3, math.inf))
    assert (none.finite, none.mean, none.halfwidth) == (0, math.inf, math.inf)


def test_differences_are_taken_draw_by_draw() -> None:
    reference = np.array([1.0, 5.0, math.inf, math.inf, 2.0])
    values = np.array([2.0, 4.0, math.inf, 3.0, 2.0])
    found = difference(values, reference)
    assert found.estimate.mean == 0.0
    assert found.estimate.finite == 3
    assert (found.larger, found.smaller) == (0.2, 0.4)
    assert found.estimate.q05 == -math.inf
    assert found.estimate.median == 0.0


def at_most(j: int, count: int, share: float) -> float:
    """P(Bin(count, share) ≤ j), term by term."""
    return math.fsum(math.comb(count, i) * share**i * (1 - share) ** (count - i) for i in range(j + 1))


@pytest.mark.parametrize(("count", "quantile"), [(100, 0.5), (200, 0.9), (400, 0.95)])
def test_ranks_are_the_tightest_with_the_required_confidence(count: int, quantile: float) -> None:
    low, high = interval_ranks(count, quantile)
    # The value of rank r (from 0) is above the quantile if at most r values are below it.
    assert at_most(high, count, quantile) >= 0.975 > at_most(high - 1, count, quantile)
    assert at_most(low, count, quantile) <= 0.025 < at_most(low + 1, count, quantile)


def test_the_share_of_runs_with_long_bursts_is_compared_with_its_probability() -> None:
    """For the largest number of packets, by the closed form for one packet in sequence."""
    loss = 'network.loss={model="bernoulli", probability=0.3}'
    settings = ("network.mansd=0", loss, "network.enforce_mansd=false")
    bursts = np.array([0.0, 1.0, 0.0, 3.0, np.inf])
    found = burst_frequency(
        load_scenario(find_shipped("lane_following", "scenarios"), settings),
        {"longest_loss_burst": bursts, "transmissions": np.array([2.0, 3.0, 4.0, 5.0, np.inf])},
    )
    assert found is not None
    assert (found.longer, found.runs, found.packets) == (2, 4, 5)
    assert found.predicted == pytest.approx(1 - 0.7**4)  # the first packet is delivered
    assert found.low < 0.5 < found.high


def test_terminal_tables_print_names_literally_and_list_failed_runs(
    write: Write, plan: dict[str, Any], run_command: Command
) -> None:
    name = "[/x] [red]"
    plan["axes"][0]["variants"] = {name: {"mode": "model"}, "ZOH": {"mode": "zoh"}}
    result = run_command(write(plan, figures=[], draws=2, metrics={"most_events": 1}))
    assert result.exit_code == 0, result.output
    text = " ".join(result.stdout.split())
    assert f"At policy {name}, beta 0.1 not all runs reached the horizon: 2 too many" in text


def test_columns_that_are_the_same_at_all_points_are_named_once() -> None:
    rows = [("MB", "0.1", "3 ± 1", "–"), ("MB", "0.5", "4 ± 1", "–")]
    full = ResultTable("campaign", "c", ("policy", "β", "cost", "bound used"), rows)
    table, names = without_constants(full, 2)
    assert (table.caption, names) == ("c; everywhere policy MB, bound used –", 1)
    assert (table.headings, table.rows) == (["β", "cost"], [["0.1", "3 ± 1"], ["0.5", "4 ± 1"]])
    only_labels = full._replace(rows=[("MB", "0.1", "3", "–"), ("MB", "0.5", "3", "–")])
    for unchanged in (full._replace(rows=rows[:1]), only_labels, full._replace(rows=[])):
        assert without_constants(unchanged, 2) == (unchanged, 2)


def test_a_caption_says_what_the_means_leave_out() -> None:
    whole, half, none = (estimate(np.array(values)) for values in ([1.0, 2.0], [1.0, np.inf], [np.inf] * 2))
    assert _left_out([whole]) == ""
    assert _left_out([whole, half]).endswith("left out, at one point 50 % of them")
    assert _left_out([whole, none]).endswith("left out; where none is left, the point is missing")
    figure = curve_figure(np.array([1.0, 2.0]), ["1", "2"], {"a": [whole, half]}, "x", "cost")
    ((panel,),) = (row.panels for row in figure.rows)
    (band,) = (item for item in panel.items if isinstance(item, Band))
    assert np.isfinite(band.high).tolist() == [True, False]  # a single run has no interval
