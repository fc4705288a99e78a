"""The certificates of a run: under its scenario's schedule, or under the times that occurred.

Their bounds are proven ones where a witness is known, or found within a limit of work.
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

from flint import fmpq

from cosim.analysis.witnesses import (
    known_or_found,
    known_or_found_on_region,
    plant_on_regions,
    resolved_content,
)
from noack.core.clock import NS_PER_S
from noack.plants.systems.traced_equations import NotEnclosedError
from noack.scenario.loads import with_constant_load
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.assumptions import Assumption, assumptions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import BOX, OWN_PLANT, allowed_conditions
from noack.theory.certificates.region import scopes
from noack.theory.certificates.scenario_certificates import outside_box
from noack.theory.witnesses.effort import NoWitnessError
from noack.theory.witnesses.outward import proven_bounds
from noack_check.keys import RefusedError
from noack_check.scenario import most_losses, read_loop

_FEW_LOOPS = 4
RUN_WORK = 2.5
"""Limit of the search for a witness of a run, some 10 s: :class:`noack.theory.witnesses.effort.Effort`."""


class Expectations(NamedTuple):
    """What follows from the scenario of a loop alone."""

    assumptions: Sequence[Assumption]
    certificates: Sequence[ScenarioCertificate] | None
    """None if they cannot be computed, which the claims then report."""


def search_limit(loops: int) -> float:
    """Return the limit of the search for a witness of one loop of a run; 0: what is known, or by gains."""
    return RUN_WORK / loops if loops <= _FEW_LOOPS else 0.0


def expectations(scenario: Scenario, loops: int) -> Expectations:
    """Return what to expect of a loop of a run with a number of loops."""
    certificates = None
    with suppress(Exception):
        certificates = scheduled_certificates(scenario, most_work=search_limit(loops))
    return Expectations(assumptions(scenario), certificates)


def expectations_key(scenario: Scenario) -> str:
    """Return what the expectations of loops depend on: equal loops share them."""
    return scenario.model_dump_json(exclude={"name", "seeds"})


def scheduled_certificates(
    scenario: Scenario,
    start_error: float | None = None,
    stated: Scenario | None = None,
    most_work: float = 0.0,
) -> list[ScenarioCertificate]:
    """Return the certificates of a resolved scenario under its schedule, if it can have any.

    Args:
        scenario: the scenario, about its set-point.
        start_error: what the input was wrong by until the first input of the controller.
        stated: the scenario with its set-point, if it has one.
        most_work: limit of the search for a witness; 0: one that is known, or by gains.
    """
    conditions = allowed_conditions(scenario)
    return certificates_under(
        conditions, scenario, start_error, stated, knows_delay=False, most_work=most_work
    )


def certificates_under(
    conditions: NetworkConditions,
    scenario: Scenario,
    start_error: float | None = None,
    stated: Scenario | None = None,
    *,
    knows_delay: bool = True,
    most_work: float = 0.0,
) -> list[ScenarioCertificate]:
    """Return the certificates of a resolved scenario under some conditions, if it can have any.

    ``knows_delay``: the largest delay of updates is that of the conditions. The others are as for
    :func:`scheduled_certificates`.
    """
    if start_error is not None:
        conditions = conditions._replace(start_s=0.0)
    certificates = [
        scope.certificate(conditions, knows_delay=knows_delay, knows_inputs=True)
        for scope in scopes(scenario, start_error)
    ]
    if start_error is not None:
        return certificates
    return with_proofs(certificates, stated or scenario, most_work)


def with_proofs(
    certificates: Sequence[ScenarioCertificate], scenario: Scenario, most_work: float
) -> list[ScenarioCertificate]:
    """Return certificates of a resolved scenario with what is proven under their conditions.

    What is proven of a loop with loads holds until they first change.
    """
    scenario = with_constant_load(scenario)
    if not scenario.certificate.prove:
        return [*certificates]
    content = resolved_content(scenario, scenario.certificate.late_periods)
    return [_with_proof(certificate, scenario, content, most_work) for certificate in certificates]


def _with_proof(
    certificate: ScenarioCertificate, scenario: Scenario, content: dict[str, object], most_work: float
) -> ScenarioCertificate:
    is_box = certificate.scope == BOX
    if is_box and outside_box(scenario) is not None:
        return certificate
    with suppress(RefusedError, NoWitnessError, NotEnclosedError):
        if certificate.conditions.dropouts > most_losses(content):
            return certificate
        if certificate.scope not in (OWN_PLANT, BOX):
            return _with_region_proof(certificate, scenario, content, most_work)
        loop = read_loop(content, box=is_box, ideal=False, longer=_times(certificate.conditions))
        witness = known_or_found(loop, lambda share: None, most_work)
        return certificate.with_proof(proven_bounds(witness.proof, loop))
    return certificate


def _with_region_proof(
    certificate: ScenarioCertificate, scenario: Scenario, content: dict[str, object], most_work: float
) -> ScenarioCertificate:
    """Return a certificate with what is proven of a plant's equations."""
    plant = plant_on_regions(scenario, content, "schedule", _times(certificate.conditions))
    witness, loop = known_or_found_on_region(plant, lambda share: None, most_work)
    return certificate.with_proof(proven_bounds(witness.proof, loop))


def _times(conditions: NetworkConditions) -> dict[str, fmpq]:
    """Return the least times of a loop under some conditions."""
    wanted = {"delay": conditions.delay_s, "age": conditions.hold_s, "start": conditions.start_s}
    return {name: fmpq(round(t_s * NS_PER_S), NS_PER_S) for name, t_s in wanted.items()}
