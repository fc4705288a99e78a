"""Simulated runs of the baseline with acknowledgements: its streams, counts and missing claims."""

from functools import cache

import pytest

from cosim.analysis.certificates import Certificates
from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.summary.summary_model import ClaimCause, ClaimKind, ClaimVerdict
from cosim.output.claim_words import claim_reason
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import continuous_loop_of
from cosim.simulation.virtual_time import simulate
from netem.core.errors import CallerError
from netem.core.packet_rows import NETEM_PACKET, Fate
from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.bernoulli import BernoulliLoss
from noack.protocol.record_tables import ACKNOWLEDGEMENTS, UPDATES
from noack.scenario.scenario import Scenario
from noack.theory.certificates.assumptions import AssumptionStatus, paper_assumptions
from tests.helpers.shipped import resolved
from tests.netem.stepped_link import Link

COARSE = ("plant.rate_hz=100", "controller.rate_hz=100", "horizon_s=6")


def acknowledged(*overrides: str) -> Scenario:
    return resolved("lane_acknowledged", *COARSE, *overrides)


def plain(*overrides: str) -> Scenario:
    return resolved("lane_following", *COARSE, *overrides)


@cache
def run_of(*overrides: str) -> RunRecord:
    return simulate(acknowledged(*overrides))


def fates(record: RunRecord, flow: int) -> list[int]:
    rows = record[NETEM_PACKET]
    values: list[int] = rows["fate"][rows["flow"] == flow].tolist()
    return values


def test_each_direction_has_its_own_random_stream() -> None:
    record, other = run_of(), simulate(plain())
    count = min(len(fates(record, UPDATES)), len(fates(other, UPDATES)))
    assert count > 5
    assert fates(record, UPDATES)[:count] == fates(other, UPDATES)[:count]
    settings = LinkSettings(impairments=(LossOf(loss=BernoulliLoss(probability=0.5)),))
    link = Link(settings, record.scenario.seeds.loss, "acknowledgement")
    answers = fates(record, ACKNOWLEDGEMENTS)
    expected = [Fate(link.decide(ACKNOWLEDGEMENTS, 48, 0).fate) for _ in answers]
    assert answers == expected
    assert {Fate.DELIVERED, Fate.DROPPED} == set(answers)


def test_the_baseline_has_the_claim_of_the_guarantee_alone() -> None:
    record = run_of()
    guarantee, claim = sorted(RunClaims(record).evaluate(), key=lambda each: each.kind)
    assert (guarantee.kind, guarantee.verdict) == (ClaimKind.GUARANTEE, ClaimVerdict.HELD)
    assert claim.verdict is ClaimVerdict.UNCHECKED
    assert claim.cause is ClaimCause.ACKNOWLEDGED
    assert 'network.protocol = "ack"' in claim_reason(claim, ())
    assert RunClaims(record).envelopes() == []
    (assumption,) = [a for a in paper_assumptions(record.scenario) if "acknowledged" in a.what]
    assert assumption.verdict is AssumptionStatus.VIOLATED
    with pytest.raises(CallerError, match=r'network\.protocol = "ack": x_s is reset'):
        continuous_loop_of(record.scenario)
    assert 'network.protocol = "ack"' in Certificates(record.scenario).answer.text
    with pytest.raises(CallerError, match=r"network\.acknowledgements.*there are none unless"):
        plain("network.acknowledgements.timeout_s=0.1")
    back = ('network.protocol="none"', "network.acknowledgements.timeout_s=0.1")
    assert not plain(*back).protocol.acknowledges
