"""The certificates of runs, searched together: under their schedules, or later ones."""

from collections.abc import Generator, Sequence
from typing import Protocol

from cosim.analysis.claims.run_parts import RunPart
from cosim.record.run_record import RunRecord
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.certificates.region import scopes
from noack.theory.certificates.solution import Search, run_searches

LateSchedules = Generator[
    NetworkConditions, Sequence[ScenarioCertificate], Sequence[ScenarioCertificate] | None
]


class LateRun(Protocol):
    """A run that may have been later than its scenario allows."""

    record: RunRecord
    part: RunPart

    def late_schedules(self) -> LateSchedules:
        """Yield the schedules to certify, and return the certificates to use."""


def late_certificates(runs: Sequence[LateRun]) -> list[Sequence[ScenarioCertificate] | None]:
    """Return the certificates under the widest of the late schedules of each run, if any."""
    by_run: list[Sequence[ScenarioCertificate] | None] = [None] * len(runs)
    due: list[tuple[int, LateSchedules, Sequence[ScenarioCertificate] | None]] = [
        (number, run.late_schedules(), None)
        for number, run in enumerate(runs)
        if run.record.scenario.coverage.some_certificate_applies
    ]
    while due:
        tried: list[tuple[int, LateSchedules, NetworkConditions]] = []
        for number, search, certificates in due:
            try:
                conditions = next(search) if certificates is None else search.send(certificates)
                tried.append((number, search, conditions))
            except StopIteration as best:
                by_run[number] = best.value
        answers = certificates_together(
            [runs[number].record.scenario for number, *_ in tried],
            [runs[number].part.start_error for number, *_ in tried],
            [conditions for *_, conditions in tried],
        )
        due = [(*search[:2], answer) for search, answer in zip(tried, answers, strict=True)]
    return by_run


def scheduled_certificates(scenario: Scenario, start_error: float | None = None) -> list[ScenarioCertificate]:
    """Return the certificates of a resolved scenario under its schedule, if it can have any.

    A part of a run that starts with an input of the part before has a ``start_error``.
    """
    (certificates,) = certificates_together([scenario], [start_error])
    return certificates


def certificates_together(
    scenarios: Sequence[Scenario],
    start_errors: Sequence[float | None] | None = None,
    conditions: Sequence[NetworkConditions] | None = None,
) -> list[list[ScenarioCertificate]]:
    """Return the certificates of several scenarios; see :func:`scheduled_certificates`.

    They are those under some conditions; by default, under the schedule of each scenario.
    """
    searches: list[Search[ScenarioCertificate]] = []
    numbers: list[int] = []
    for number, scenario in enumerate(scenarios):
        if not scenario.coverage.some_certificate_applies:
            continue
        limits = allowed_conditions(scenario) if conditions is None else conditions[number]
        error = None if start_errors is None else start_errors[number]
        if error is not None:
            limits = limits._replace(start_s=0.0)
        for scope in scopes(scenario, error):
            searches.append(scope.search(limits))
            numbers.append(number)
    by_scenario: list[list[ScenarioCertificate]] = [[] for _ in scenarios]
    for number, certificate in zip(numbers, run_searches(searches), strict=True):
        by_scenario[number].append(certificate)
    return by_scenario
