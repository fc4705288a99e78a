"""The certificates of a run: under its scenario's schedule, or under the times that occurred."""

from contextlib import suppress
from typing import NamedTuple

from flint import fmpq

from cosim.analysis.conformance.run_document import RunDocument, document_of_statement
from cosim.analysis.loop_files import naming_of
from cosim.analysis.scenario_certificates import certificate_of
from cosim.analysis.witnesses import WitnessedStatement, find_statement, plants_of
from netem.core.clock import NS_PER_S
from netem.core.settings_section import Table
from noack.proof.loop_document import NoDocumentError
from noack.scenario.loads import with_constant_load
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import NetworkConditions, allowed_conditions, certified_delay_s

_FEW_LOOPS = 4
RUN_WORK = 2.5
"""Limit of the search for a witness of a run, some 10 s: :class:`noack.theory.witnesses.effort.Effort`."""


class RunCertificate(NamedTuple):
    """A certificate, and the loop document with which a run is compared."""

    certificate: ScenarioCertificate
    document: RunDocument | None
    """None: there is no certificate, or no document describes the loop."""
    missing: str = ""
    """Why no document describes it."""


def search_limit(loops: int) -> float:
    """Return the limit of the search for a witness of one loop of a run; 0: what is known, or by gains."""
    return RUN_WORK / loops if loops <= _FEW_LOOPS else 0.0


def expected_certificates(scenario: Scenario, loops: int) -> list[RunCertificate] | None:
    """Return the certificates of a loop of a run with a number of loops; None if that fails."""
    with suppress(Exception):
        return scheduled_certificates(scenario, search_limit(loops))
    return None


def certificates_key(scenario: Scenario) -> str:
    """Return what the certificates of loops depend on: equal loops share them."""
    return scenario.model_dump_json(exclude={"name", "seeds"})


def scheduled_certificates(scenario: Scenario, most_work: float = 0.0) -> list[RunCertificate]:
    """Return the certificates of a resolved scenario under its schedule, void ones with the reason.

    ``most_work``: limit of the search for a witness; 0: one that is known, or by gains.
    """
    return certificates_under(allowed_conditions(scenario), scenario, most_work)


def certificates_under(
    conditions: NetworkConditions, scenario: Scenario, most_work: float = 0.0
) -> list[RunCertificate]:
    """Return the certificates of a resolved scenario, where its times are at least those of some conditions.

    They hold until a setting on which they depend, or a load, first changes, and until the plant first
    applies an input of the watchdog, or a safe one: the run shows when.
    """
    scenario = _checked_by_run(with_constant_load(scenario))
    if not scenario.certificate.prove:
        most_work = 0.0
    times_s = {
        "delay": conditions.delay_s,
        "age": conditions.hold_s,
        "lead": conditions.lead_s,
        "start": conditions.start_s,
    }
    longer = {name: fmpq(round(t_s * NS_PER_S), NS_PER_S) for name, t_s in times_s.items()}
    statements = (
        find_statement(scenario, plants, "schedule", most_work=most_work, longer=longer)
        for plants in plants_of(scenario)
    )
    return [_with_document(scenario, statement, conditions) for statement in statements]


def _with_document(
    scenario: Scenario, statement: WitnessedStatement, conditions: NetworkConditions
) -> RunCertificate:
    certificate = certificate_of(scenario, statement, conditions)
    if not certificate.exists:
        return RunCertificate(certificate, None)
    try:
        return RunCertificate(certificate, document_of_statement(statement, naming_of(scenario, statement)))
    except NoDocumentError as error:
        return RunCertificate(certificate, None, str(error))


def _checked_by_run(scenario: Scenario) -> Scenario:
    """Return a scenario without what a run checks itself: delays, and inputs that are not the controller's.

    Where the delay in a queue is not known, it stays so.
    """
    plant, network = scenario.plant, scenario.network
    watchdog = plant.watchdog.model_copy(update={"policy": "hold"})
    update: Table = {
        "plant": plant.model_copy(update={"watchdog": watchdog}),
        "controller": scenario.controller.model_copy(update={"safe_input": None}),
    }
    if not network.link.queues or scenario.certificate.network_delay_s is not None:
        stated = {"network_delay_s": float(certified_delay_s(scenario))}
        update["certificate"] = scenario.certificate.model_copy(update=stated)
        update["network"] = network.model_copy(update={"impairments": ()})
    return scenario.model_copy(update=update)
