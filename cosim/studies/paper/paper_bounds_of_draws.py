"""The bounds for the measures of a draw: certified bounds, and the paper's formulas."""

import math
from typing import NamedTuple

from cosim.studies.paper.draw_measures import resolved_draw
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.theory.certificate import Constants
from noack.theory.paper_bounds import theorem_2
from noack.theory.run_conditions import ideal_conditions
from noack.theory.scenario_certificates import certify


class Certified(NamedTuple):
    """Certified constants of a draw's MB-ET loop, in the paper's setting."""

    inter_event_s: float
    """δ: a lower bound of the inter-event times."""
    delta: float
    """Δ: ‖e_c‖ ≤ Δβe^{−αt}."""
    state: float
    """X: ‖x‖ ≤ Xe^{−αt}."""


class Printed(NamedTuple):
    """Theorem 2 for a draw's MB-ET loop, with the certified Δ in place of Theorem 1's."""

    inter_event_s: float
    """δ̲ of eq:tau for every t_i."""
    first_s: float
    """eq:tau at t_i = 0."""
    late_s: float
    """eq:tau as t_i → ∞."""
    negative: float
    """1 if F̄ < 0."""


def certified(scenario: Scenario, draw: int) -> Certified:
    """Return the certificate of a draw; zeros and infinities if there is none."""
    constants = _constants(scenario, draw)
    if constants is None:
        return Certified(0.0, math.inf, math.inf)
    return Certified(constants.inter_event_s or 0.0, constants.delta, constants.state)


def printed(scenario: Scenario, draw: int) -> Printed:
    """Return Theorem 2 for a draw; zeros if it does not apply."""
    resolved, constants = resolved_draw(scenario, draw, "model"), _constants(scenario, draw)
    trigger, nothing = resolved.decaying, Printed(0.0, 0.0, 0.0, 0.0)
    if constants is None:
        return nothing
    found = theorem_2(loop_of(resolved), trigger.beta, trigger.alpha_per_s, constants.delta)
    if found is None:
        return nothing
    start = found.a_tilde * (found.state_start - found.state_forced)  # F̄
    gap = found.alpha_bar_per_s - trigger.alpha_per_s
    forced = (gap / found.c + found.a_tilde) * found.state_forced  # F
    rate, late = found.a_hat + found.alpha_bar_per_s, forced / (found.a_hat + trigger.alpha_per_s)
    first_s, late_s = (
        math.log1p(trigger.beta / F) / rate if F > 0 else math.inf
        for F in (start / rate + late, late)
    )
    return Printed(found.inter_event_s, first_s, late_s, float(start < 0))


def _constants(scenario: Scenario, draw: int) -> Constants | None:
    resolved = resolved_draw(scenario, draw, "model")
    return certify(resolved, ideal_conditions(resolved)).constants
