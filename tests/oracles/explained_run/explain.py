"""Whether a recorded run is a run of the hybrid model of its scenario.

This reads the record alone, with numpy and scipy, and shares none of the core's steps: what it
finds is a mistake of the translation from settings to the model, of the core, or of the record. It
covers a run up to the first change of a setting that the model depends on, and a run that diverges
up to its first extreme number. Acknowledgements, users' control laws and nonlinear plants are not
part of the model: of these x_s, u or x is not checked.
"""

from cosim.record.run_record import RunRecord
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import NetworkConditions, nominal_conditions
from noack.theory.coverage import is_papers_loop
from tests.oracles.explained_run.applied_inputs import check_applied, check_schedule
from tests.oracles.explained_run.controller_inputs import check_controller
from tests.oracles.explained_run.findings import ExplainedLoop, Unexplained
from tests.oracles.explained_run.network_losses import check_updates
from tests.oracles.explained_run.plant_flow import check_measurements, check_observer, check_plant
from tests.oracles.explained_run.sensor_events import check_events

_CHECKS = (
    check_plant, check_measurements, check_observer, check_events, check_updates, check_controller,
    check_applied,
)  # fmt: skip


def explains(record: RunRecord, conditions: NetworkConditions | None = None) -> list[Unexplained]:
    """Return what the model does not explain in the record of a loop, in the order of time.

    An empty list: the run is a run of the model. In virtual time nothing is late. A live run
    may exceed the times of the schedule if the machine was late: such findings have the part
    `.findings.SCHEDULE`.

    Args:
        record: the record of the loop.
        conditions: the times that the model allows; by default those of the loop's certificates, if
            they do not depend on the machine.
    """
    run = ExplainedLoop(record)
    for check in _CHECKS:
        check(run)
    if conditions is None and states_schedule(record.scenario):
        late = 0 if record.kind == "simulated" else record.scenario.certificate.late_periods
        conditions = nominal_conditions(record.scenario, late)
    if conditions is not None:
        check_schedule(run, conditions)
    return sorted(run.findings, key=lambda finding: finding.t_s)


def states_schedule(resolved: Scenario) -> bool:
    """Whether the times of a loop's updates and inputs have bounds that do not depend on the machine.

    A watchdog may replace inputs where actuations may be lost.
    """
    network = resolved.network
    directions = [network.link] + ([] if network.actuation is None else [network.actuation.link])
    stated_s = resolved.certificate.network_delay_s
    return (
        is_papers_loop(resolved)
        and network.enforce_mansd
        and (network.actuation is None or resolved.plant.watchdog.policy == "hold")
        and all(link.delay_is_bounded for link in directions)
        and (stated_s is None or stated_s >= network.link.longest_delay_s)
    )
