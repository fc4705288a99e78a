"""Self-triggered control: at each event the sensor says when the next one is, and sleeps.

It assumes d‖e_s‖_W/dt ≤ L‖e_s‖_W + a‖x(t_k)‖_W + b between events, so that

    ‖e_s(t_k + τ)‖_W ≤ (a‖x(t_k)‖_W + b) (e^{Lτ} − 1)/L,

and transmits when this bound reaches max(βe^{−α(t_k+τ)}, ε), though within [τ_min, τ_max]. Where
the assumption holds, and τ_min has not delayed it, ‖e_s‖_W stays below the paper's threshold
without being watched. (The idea is that of Anta & Tabuada, IEEE TAC 55(9), 2010; the bound is
Gronwall's.)
"""

from dataclasses import dataclass

from noack.core.linear_systems import Matrix
from noack.trigger.self_triggered_interval import Forecast
from noack.trigger.trigger_condition import QuadraticForm, empty_map
from noack.trigger.trigger_rule import TriggerRule


@dataclass(frozen=True)
class SelfTrigger:
    """The self-triggered rule.

    Args:
        beta: β > 0, in the units of ‖W x‖.
        alpha_per_s: α > 0.
        floor: ε ≥ 0.
        growth_per_s: L ≥ 0.
        mismatch_per_s: a ≥ 0.
        disturbance_per_s: b ≥ 0, in the units of ‖W x‖ per second.
        shortest_ns: τ_min > 0.
        longest_ns: τ_max.
        weight: W, shape (n, n), or None for the identity.
    """

    beta: float
    alpha_per_s: float
    floor: float
    growth_per_s: float
    mismatch_per_s: float
    disturbance_per_s: float
    shortest_ns: int
    longest_ns: int
    weight: Matrix | None = None
    initial_dynamic_variable = 0.0

    def trigger_rule(self, n: int) -> TriggerRule:
        """The time of the next event, from the state at this one."""
        forecast = Forecast(
            self.beta, self.alpha_per_s, self.floor,
            self.growth_per_s, self.mismatch_per_s, self.disturbance_per_s,
        )  # fmt: skip
        return TriggerRule(
            QuadraticForm(empty_map(n), empty_map(n)),
            longest_ns=self.longest_ns, shortest_ns=self.shortest_ns,
            forecast=forecast, weight=self.weight,
        )  # fmt: skip
