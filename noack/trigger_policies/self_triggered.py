"""Self-triggered control: at each event the sensor computes the time of the next one.

It assumes d‖e_s‖_W/dt ≤ L‖e_s‖_W + a‖x(t_k)‖_W + b between events, so that

    ‖e_s(t_k + τ)‖_W ≤ (a‖x(t_k)‖_W + b) (e^{Lτ} − 1)/L,

and it transmits when this bound reaches max(βe^{−α(t_k+τ)}, ε), within [τ_min, τ_max]. Where
the assumption holds, and τ_min has not delayed it, ‖e_s‖_W stays below the paper's threshold
without being tested. (The idea is that of Anta & Tabuada, IEEE TAC 55(9), 2010; the bound is
Gronwall's.)
"""

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

from pydantic import model_validator

from netem.core.periods import whole_ns
from netem.core.settings_section import NonNegative, Positive
from noack.trigger_policies.decaying import decaying_text
from noack.trigger_policies.policy_settings import IntervalS, ModelMatrices, WeightedSettings
from noack.trigger_policies.trigger_rule import Forecast, TriggerRule, no_form


class SelfTriggeredSettings(WeightedSettings):
    """At each event the sensor computes the time of the next one.

    This is the time at which ‖e_s‖_W could reach the paper's threshold, given
    d‖e_s‖_W/dt ≤ L‖e_s‖_W + a‖x(t_k)‖_W + b.
    """

    example_keys: ClassVar = {
        "beta": 0.5,
        "alpha_per_s": 0.25,
        "growth_per_s": 1.0,
        "mismatch_per_s": 1.0,
        "shortest_s": 0.1,
        "longest_s": 5.0,
    }

    policy: Literal["self_triggered"]
    beta: Positive
    """β, in the units of ‖W x‖."""
    alpha_per_s: Positive
    """α, per second."""
    floor: NonNegative = 0.0
    """ε."""
    growth_per_s: NonNegative
    """L."""
    mismatch_per_s: NonNegative
    """a."""
    disturbance_per_s: NonNegative = 0.0
    """b, in the units of ‖W x‖ per second."""
    shortest_s: IntervalS
    """Shortest time to the next event."""
    longest_s: IntervalS
    """Longest time to the next event."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.longest_s < self.shortest_s:
            raise ValueError("longest_s: must not be less than shortest_s")
        return self

    def intervals(self) -> Mapping[str, tuple[str, float]]:
        return {
            "shortest_s": ("events are at measurements, at the earliest after", self.shortest_s),
            "longest_s": ("events are at measurements, at the latest after", self.longest_s),
        }

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        forecast = Forecast(
            self.beta,
            self.alpha_per_s,
            self.floor,
            self.growth_per_s,
            self.mismatch_per_s,
            self.disturbance_per_s,
        )
        return TriggerRule(
            no_form(len(model.A)),
            shortest_ns=whole_ns(self.shortest_s),
            longest_ns=whole_ns(self.longest_s),
            forecast=forecast,
            weight=self.weight_matrix,
        )

    @property
    def description(self) -> str:
        threshold = decaying_text(self.beta, self.alpha_per_s, self.floor)
        return f"‖e_s‖ could reach {threshold}, as forecast at the last event"
