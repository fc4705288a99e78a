"""The certificates of the random loops of ``tests/oracles/lossy_loops.py``."""

from hypothesis import assume

from noack.guarantee.loss_guarantee import (
    DeliveriesBetweenBursts,
    LongestBurst,
    LossesInWindow,
    LossGuarantee,
    LossRule,
)
from noack.theory.bounds.certificate_terms import (
    Constants,
    NetworkConditions,
    NoCertificateError,
    TriggerBound,
)
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.certificates.solution import solve
from tests.oracles.lossy_loops import System


def guarantee_of(system: System) -> LossGuarantee:
    """The rules of the network's losses."""
    rules: list[LossRule] = [LongestBurst(system.mansd)]
    rules += [LossesInWindow(*system.window)] if system.window[0] < system.window[1] else []
    rules += [DeliveriesBetweenBursts(system.recovery)] if system.recovery else []
    return LossGuarantee(tuple(rules))


def conditions_of(system: System) -> NetworkConditions:
    """The conditions of the simulation that the certificate may assume."""
    applied_input = system.delay_steps
    applied_input += system.hold_steps - 1 + system.lag if system.hold_steps else 0
    sampling_s, guarantee = system.sample_steps * system.step_s, guarantee_of(system)
    return NetworkConditions(
        dropouts=guarantee.longest_burst,
        constraints=guarantee.rules[1:],
        sampling_s=sampling_s,
        spacing_s=sampling_s,
        delay_s=applied_input * system.step_s,
        hold_s=(system.hold_steps + system.lag) * system.step_s,
        start_s=applied_input * system.step_s,
    )


def gains_of(
    system: System, error: type[ErrorGains] = ErrorGains, plant: type[PlantGains] = PlantGains
) -> PlantGains:
    models = error(system.H, system.K, system.weight, system.alpha)
    return plant(models, system.A, system.B, system.x0[:, None], system.alpha)


def certify_loop(
    system: System,
    conditions: NetworkConditions | None = None,
    plant: PlantGains | None = None,
) -> Constants:
    plant, level = plant or gains_of(system), TriggerBound(system.beta, system.beta)
    conditions = conditions or conditions_of(system)
    return solve(plant.error, plant, conditions, level)


def certified_or_skipped(system: System, conditions: NetworkConditions | None = None) -> Constants:
    try:
        return certify_loop(system, conditions)
    except NoCertificateError:
        assume(False)
        raise
