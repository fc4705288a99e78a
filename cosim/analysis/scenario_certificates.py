"""A certificate from what was proven of a scenario, or from the reason why nothing was."""

from cosim.analysis.witnesses import WitnessedStatement, find_statement
from noack.scenario.scenario import Scenario
from noack.theory.certificates.assumptions import certificate_assumptions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import (
    BOX,
    EQUATIONS,
    OWN_PLANT,
    NetworkConditions,
    allowed_conditions,
    ideal_conditions,
    kept_probability,
)

_SCOPES = {"own": OWN_PLANT, "box": BOX, "region": EQUATIONS}
"""Names of plants, by those of statements."""


def certificate_of(
    resolved: Scenario, statement: WitnessedStatement, conditions: NetworkConditions
) -> ScenarioCertificate:
    """Return the certificate of a resolved scenario with what is proven under some conditions."""
    probability, bounds = None, statement.bounds
    if bounds is not None and not resolved.network.enforce_mansd:
        probability = kept_probability(resolved, conditions, bounds)
    assumed = tuple(certificate_assumptions(resolved, conditions, probability))
    void = None if bounds is not None else statement.reason
    return ScenarioCertificate(_SCOPES[statement.plants], conditions, assumed, bounds, void)


def quick_certificate(resolved: Scenario, plants: str = "own", *, ideal: bool = False) -> ScenarioCertificate:
    """Return a certificate with what is known already, or proven by gains, in seconds.

    Args:
        resolved: the scenario.
        plants: one of :func:`cosim.analysis.witnesses.plants_of`.
        ideal: under the paper's conditions; else under the scenario's schedule, with its lateness.
    """
    statement = find_statement(resolved, plants, "ideal" if ideal else "schedule", most_work=0.0)
    conditions = ideal_conditions(resolved) if ideal else allowed_conditions(resolved)
    return certificate_of(resolved, statement, conditions)
