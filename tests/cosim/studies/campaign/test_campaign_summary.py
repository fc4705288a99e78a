"""The summary of a campaign."""

import pytest

from cosim.studies.campaign.campaign_summary import summarise
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.metrics import estimate
from tests.cosim.studies.campaign.conftest import Few


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
