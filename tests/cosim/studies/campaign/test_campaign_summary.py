"""The summary of a campaign, and the verdicts of its claims."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.studies.campaign.campaign_file import load
from cosim.studies.campaign.campaign_grid import Point
from cosim.studies.campaign.campaign_summary import EvaluatedClaim, evaluate_claims, summarise
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import Metric, estimate
from noack.core.linear_systems import Vector
from tests.cosim.studies.campaign.conftest import Few, Write, few_of
from tests.helpers.approved import compare_lines, lines_of_error


def test_a_summary_covers_all_draws_and_pairs_them(full: Store, campaign: Few) -> None:
    summary = summarise(campaign[0], full)
    rows = [point.work.run(range(7)) for point in campaign[1]]
    for result, row in zip(summary.results, rows, strict=True):
        assert result.estimates["cost"].mean == pytest.approx(row["cost"].mean(), rel=1e-12)
        assert result.ended == {"finished": 7}
    assert ["certificate_used" in result.estimates for result in summary.results] == [
        True, True, False, False
    ]  # fmt: skip
    assert summary.breaches == 0
    assert [(c.point.number, c.reference.number) for c in summary.compared] == [(0, 2), (1, 3)]
    differences = (rows[0]["transmissions"] - rows[2]["transmissions"]).astype(float)
    assert summary.compared[0].differences["transmissions"].estimate == estimate(differences)
    assert differences.std() < rows[2]["transmissions"].std() or differences.mean() < 0


MORE = {"says": "ZOH sends more.", "axis": "policy",
        "holds": ["transmissions @ ZOH > transmissions @ MB"]}  # fmt: skip


def evaluated(write: Write, plan: dict[str, Any], claim: dict[str, Any], zoh: Vector) -> EvaluatedClaim:
    """Judge a claim about runs with 10 transmissions of MB, and those of ZOH at β = 0.1."""
    plan["claims"] = [claim]
    campaign, points = few_of(write(plan))

    def values(point: Point) -> dict[Metric, Vector]:
        first = point.labels["policy"] == "ZOH" and point.labels["beta"] == "0.1"
        mb = np.full(len(zoh), 10.0)
        return {"transmissions": zoh if first else mb + 5 * (point.labels["policy"] == "ZOH")}

    (claim,) = evaluate_claims(campaign, points, values)
    return claim


@pytest.mark.parametrize(
    ("share", "verdict"), [(1.0, "confirmed"), (0.95, "confirmed"), (0.94, "partly"),
                           (0.5, "partly"), (0.49, "not confirmed")],
)  # fmt: skip
def test_a_verdict_follows_from_the_share_of_the_draws(
    write: Write, plan: dict[str, Any], share: float, verdict: str
) -> None:
    zoh = np.where(np.arange(100) < 100 * share, 11.0, 9.0)
    claim = evaluated(write, plan, MORE, zoh)
    assert (claim.share, claim.verdict) == (share, verdict)
    assert claim.least_at == "beta 0.1"
    assert "transmissions at ZOH 11" in claim.medians or share <= 0.5


def test_the_least_favourable_grid_point_counts_unless_it_is_left_out(
    write: Write, plan: dict[str, Any]
) -> None:
    fewer = MORE | {"holds": ["transmissions @ ZOH < transmissions @ MB"]}
    claim = evaluated(write, plan, fewer, np.full(4, 9.0))
    assert (claim.share, claim.least, claim.least_at) == (1.0, 0.0, "beta 0.3")
    assert claim.verdict == "partly"
    plan["claims_at"] = {"beta": [0.1]}
    assert evaluated(write, plan, fewer, np.full(4, 9.0)).verdict == "confirmed"


def test_a_mistake_in_a_claim_gives_the_approved_line(write: Write, plan: dict[str, Any]) -> None:
    def mistake(changed: str) -> list[str]:
        claim = {key: value for key, value in (MORE | json.loads(changed)).items() if value}
        file = write(plan | {"claims": [claim]})
        return lines_of_error(lambda: load(file), FILE=file)

    compare_lines(Path(__file__).with_name("claim_mistakes.txt"), mistake)
