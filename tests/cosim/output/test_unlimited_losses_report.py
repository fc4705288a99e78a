"""What ``noack certify`` says without the guarantee, against simulated runs and closed forms."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.certificates import Certificates
from noack.impairments.loss_guarantee import LossHistory
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.certificates.conditions import most_events
from noack.theory.random_losses.moments import UnlimitedLosses

ROOT = Path(__file__).parents[3]
P = 0.05
LOSSES = f'network.loss={{model="bernoulli", probability={P}}}'


def lane(*settings: str) -> Scenario:
    return resolve(load(ROOT / "scenarios/lane_weighted.toml", settings))


def certificates(*settings: str) -> Certificates:
    return Certificates(lane("network.enforce_mansd=false", LOSSES, *settings), 2)


@pytest.fixture(scope="module")
def own() -> Certificates:
    return certificates()


@pytest.fixture(scope="module")
def weighted(own: Certificates) -> UnlimitedLosses:
    assert own.unlimited is not None
    return own.unlimited


def test_in_the_chosen_norm_the_mean_at_events_is_beta_over_1_minus_p(
    weighted: UnlimitedLosses,
) -> None:
    mean, root_mean_square = weighted.at_events
    assert mean == pytest.approx(1 / (1 - P), rel=1e-6)
    assert root_mean_square == pytest.approx(1 / (1 - P**0.5), rel=1e-6)
    assert weighted.paper_rate_per_s == 0.25


def test_longer_bursts_are_less_likely_and_have_larger_bounds(weighted: UnlimitedLosses) -> None:
    bursts = weighted.bursts
    assert [one.most for one in bursts] == list(range(len(bursts)))
    for shorter, longer in pairwise(bursts):
        assert shorter.probability < longer.probability
        assert shorter.state < longer.state
    assert bursts[0].probability == pytest.approx((1 - P) ** (bursts[0].events - 1))


def test_a_run_of_the_largest_number_of_events_keeps_the_assumption_as_often_as_stated() -> None:
    """By 4000 sequences of losses that are drawn here."""
    found = certificates("network.mansd=2").schedule
    assert found.inter_event_s is not None
    packets = most_events(
        resolve(load(ROOT / "scenarios/lane_weighted.toml", ())), found.inter_event_s
    )
    lost = np.random.default_rng(1).uniform(size=(4000, packets)) < P
    lost[:, 0] = False
    kept = 0
    for row in lost.tolist():
        history = LossHistory(found.conditions.guarantee.rules)
        kept += not any(history.add(one) for one in row)
    (why,) = (one.why for one in found.assumptions if "not enforced" in one.why)
    stated = float(why.split("probability ")[1].split()[0])
    assert abs(kept / 4000 - stated) < 5 * (stated * (1 - stated) / 4000) ** 0.5


def test_there_is_no_statement_where_losses_depend_on_times_and_the_reason_is_named() -> None:
    found = certificates("network.impairments=[{kind='rate', rate_bps=1_000_000}]")
    assert found.unlimited is None
    assert found.unpredictable is not None
    assert Certificates(lane(), 2).unlimited is None
