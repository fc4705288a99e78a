"""The network's guarantee as a claim: kept where the network enforces it, broken where nothing does."""

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.claims.guarantee_claims import guarantee_claims
from cosim.analysis.summary.summary_model import ClaimKind, ClaimVerdict
from cosim.record.run_events import packet_outcomes
from cosim.simulation.virtual_time import simulate
from tests.helpers.shipped import resolved

LOSSES = 'network.loss={model="bernoulli", probability=0.9}'


def test_an_enforced_guarantee_is_a_claim_that_holds() -> None:
    record = simulate(resolved("double_integrator", "horizon_s=4", LOSSES))
    claims = [claim for claim in RunClaims(record).evaluate() if claim.kind is ClaimKind.GUARANTEE]
    assert claims == guarantee_claims(record)
    (claim,) = claims
    most = record.scenario.network.mansd
    assert claim.verdict is ClaimVerdict.HELD
    assert (claim.certified, claim.observed, claim.ratio, claim.since_s) == (most, most, 1.0, None)
    assert claim.bound == f"at most {most} lost in a row"


def test_a_guarantee_that_nothing_enforces_is_broken_at_the_first_loss_beyond_it() -> None:
    record = simulate(resolved("double_integrator", "horizon_s=4", LOSSES, "network.enforce_mansd=false"))
    (claim,) = guarantee_claims(record)
    most, outcomes = record.scenario.network.mansd, packet_outcomes(record)
    in_a_row = np.convolve(outcomes.lost, np.ones(most + 1, int))[: len(outcomes.lost)] == most + 1
    assert claim.verdict is ClaimVerdict.VIOLATED
    assert claim.since_s == pytest.approx(outcomes.event_ns[np.argmax(in_a_row)] * 1e-9)
    assert claim.observed == outcomes.longest_loss_burst()


def test_each_rule_is_a_claim() -> None:
    rule = 'network.constraints=[{ kind = "at_most", losses = 2, window = 4 }]'
    record = simulate(resolved("double_integrator", "horizon_s=4", "network.mansd=3", rule, LOSSES))
    claims = guarantee_claims(record)
    assert [claim.verdict for claim in claims] == [ClaimVerdict.HELD] * len(claims)
    assert {claim.bound for claim in claims} >= {"at most 2 losses in 4 consecutive packets"}
