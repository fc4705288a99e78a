"""The paper's statements are checked in a run where its scenario asks for them, and only there."""

from cosim.analysis.claims.claim_catalogue import CERTIFIED_AND_IDENTITY, PAPER, claims_about
from noack.theory.certificates.assumptions import assumptions
from tests.helpers.shipped import resolved

PERIODIC = "trigger={policy='periodic', period_s=0.01}"


def test_a_users_scenario_has_the_identity_and_the_certificates() -> None:
    scenario = resolved("double_integrator")
    assert not scenario.certificate.paper
    assert claims_about(scenario) == CERTIFIED_AND_IDENTITY
    assert {each.source for each in assumptions(scenario)} == {"certificates", "guarantee"}


def test_the_papers_scenario_has_the_papers_statements_too() -> None:
    scenario = resolved("lane_following")
    assert scenario.certificate.paper
    assert claims_about(scenario) == (*CERTIFIED_AND_IDENTITY, *PAPER)
    assert {"Theorem 2", "Section II", "Section III"} <= {each.source for each in assumptions(scenario)}
