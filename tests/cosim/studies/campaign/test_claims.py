"""Claims of a campaign: their verdicts follow from the draws, by the rule of the file."""

from typing import Any

import numpy as np
import pytest

from cosim.studies.campaign.campaign_file import load
from cosim.studies.campaign.campaign_grid import Point
from cosim.studies.campaign.campaign_report import claims_table
from cosim.studies.campaign.campaign_summary import JudgedClaim, judge_claims, share_text, summarise
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import Metric
from noack.core.errors import CallerError
from noack.core.linear_systems import Vector
from tests.cosim.studies.campaign.conftest import Few, Write, few_of

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
    ("share", "verdict"), [(1.0, "confirmed"), (0.96, "confirmed"), (0.9, "partly"),
                           (0.4, "not confirmed")],
)  # fmt: skip
def test_a_verdict_follows_from_the_share_of_the_draws(
    write: Write, plan: dict[str, Any], share: float, verdict: str
) -> None:
    zoh = np.where(np.arange(100) < 100 * share, 11.0, 9.0)
    found = judged(write, plan, MORE, zoh)
    assert (found.share, found.verdict) == (share, verdict)
    assert found.least_at == "beta 0.1"
    assert "transmissions at ZOH 11" in found.medians or share < 0.5


def test_the_least_favourable_grid_point_counts_unless_it_is_left_out(
    write: Write, plan: dict[str, Any]
) -> None:
    fewer = MORE | {"holds": ["transmissions @ ZOH < transmissions @ MB"]}
    found = judged(write, plan, fewer, np.full(4, 9.0))
    assert (found.share, found.least, found.least_at) == (1.0, 0.0, "beta 0.3")
    assert found.verdict == "partly"
    plan["claims_at"] = {"beta": [0.1]}
    assert judged(write, plan, fewer, np.full(4, 9.0)).verdict == "confirmed"


def test_medians_and_numbers_can_be_compared(write: Write, plan: dict[str, Any]) -> None:
    zoh = np.array([1.0, 11.0, 12.0])
    assert judged(write, plan, MORE | {"medians": True}, zoh).share == 1.0
    number = {"says": "Few.", "where": {"policy": "ZOH", "beta": 0.1},
              "holds": ["transmissions < 12", "transmissions > 0.5"]}  # fmt: skip
    assert judged(write, plan, number, zoh).share == pytest.approx(2 / 3)


def test_a_metric_that_a_grid_point_does_not_have_fulfils_no_condition(
    write: Write, plan: dict[str, Any], full: Store, campaign: Few
) -> None:
    plan["claims"] = [{"says": "The bound holds.", "holds": ["certificate_used < 1"]}]
    (claim,) = summarise(load(write(plan)), full).claims
    assert (claim.share, claim.least, claim.verdict) == (1.0, 0.0, "partly")
    assert claim.least_at.startswith("policy ZOH")


def test_claims_are_in_the_summary(
    write: Write, plan: dict[str, Any], full: Store, campaign: Few
) -> None:
    plan["claims"] = [MORE, {"says": "It settles.", "holds": ["settling_s < 100"]}]
    summary = summarise(load(write(plan)), full)
    first, second = summary.document()["claims"]
    assert first["verdict"] == "confirmed"
    assert second["least_at"].startswith("policy ")
    assert [row[0] for row in claims_table(summary).rows] == ["ZOH sends more.", "It settles."]


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"holds": ["transmissions"]}, "write a condition as A < B or A > B"),
        ({"holds": ["events @ ZOH > 1"]}, "events @ ZOH: should be a number or one of"),
        ({"holds": ["transmissions @ PB > 1"]}, "no such value; policy has MB, ZOH"),
        ({"axis": None}, "axis: give an axis, and a value of it after each metric, or neither"),
        ({"axis": "polic"}, "no such axis"),
        ({"where": {"beta": 0.2}}, "no such value; beta has 0.1, 0.3"),
    ],
)
def test_a_mistake_is_one_line(
    write: Write, plan: dict[str, Any], changed: dict[str, Any], expected: str
) -> None:
    claim = {key: value for key, value in (MORE | changed).items() if value is not None}
    with pytest.raises(CallerError) as found:
        load(write(plan | {"claims": [claim]}))
    assert "\n" not in str(found.value)
    assert expected in str(found.value)


def test_a_share_is_100_percent_only_if_it_is_complete() -> None:
    assert [share_text(s) for s in (1.0, 0.999, 0.75, 0.004, 0.0)] == [
        "100 %", "99.9 %", "75 %", "0.4 %", "0 %",
    ]  # fmt: skip
