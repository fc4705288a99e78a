"""The certificates of a run: under its scenario's schedule, or under the times that occurred."""

from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import allowed_conditions, void_without_delay
from noack.theory.certificates.region import scopes


def scheduled_certificates(scenario: Scenario, start_error: float | None = None) -> list[ScenarioCertificate]:
    """Return the certificates of a resolved scenario under its schedule, if it can have any.

    ``start_error``: what the input was wrong by until the first input of the controller.
    """
    conditions = allowed_conditions(scenario)
    return certificates_under(conditions, scenario, start_error, void_without_delay(scenario, conditions))


def certificates_under(
    conditions: NetworkConditions,
    scenario: Scenario,
    start_error: float | None = None,
    void: str | None = None,
) -> list[ScenarioCertificate]:
    """Return the certificates of a resolved scenario under some conditions, if it can have any.

    ``void``: why there are none, if that is known.
    """
    if start_error is not None:
        conditions = conditions._replace(start_s=0.0)
    return [scope.certificate_unless(void, conditions) for scope in scopes(scenario, start_error)]
