"""The certificates of a run: under its scenario's schedule, or under the times that occurred."""

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.assumptions import Assumption, assumptions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.region import scopes


class Expectations(NamedTuple):
    """What follows from the scenario of a loop alone."""

    assumptions: Sequence[Assumption]
    certificates: Sequence[ScenarioCertificate] | None
    """None if they cannot be computed, which the claims then report."""


def expectations(scenario: Scenario) -> Expectations:
    """Return what to expect of a loop."""
    certificates = None
    with suppress(Exception):
        certificates = scheduled_certificates(scenario)
    return Expectations(assumptions(scenario), certificates)


def expectations_key(scenario: Scenario) -> str:
    """Return what the expectations of loops depend on: equal loops share them."""
    return scenario.model_dump_json(exclude={"name", "seeds"})


def scheduled_certificates(scenario: Scenario, start_error: float | None = None) -> list[ScenarioCertificate]:
    """Return the certificates of a resolved scenario under its schedule, if it can have any.

    ``start_error``: what the input was wrong by until the first input of the controller.
    """
    return certificates_under(allowed_conditions(scenario), scenario, start_error, knows_delay=False)


def certificates_under(
    conditions: NetworkConditions,
    scenario: Scenario,
    start_error: float | None = None,
    *,
    knows_delay: bool = True,
) -> list[ScenarioCertificate]:
    """Return the certificates of a resolved scenario under some conditions, if it can have any.

    ``knows_delay``: the largest delay of updates is that of the conditions.
    """
    if start_error is not None:
        conditions = conditions._replace(start_s=0.0)
    return [
        scope.certificate(conditions, knows_delay=knows_delay, knows_inputs=True)
        for scope in scopes(scenario, start_error)
    ]
