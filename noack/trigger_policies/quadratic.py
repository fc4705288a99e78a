"""Periodic event-triggered control: at sampling times, transmit when zᵀQz > ε, z = (x, e_s).

(Heemels, Donkers, Teel: IEEE TAC 58(4), 2013.) The minimum inter-event time is the sampling
period by construction. A heartbeat transmits after a number of periods without an event.
"""

import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field

from netem.core.clock import NS_PER_S
from netem.core.periods import Period, exact_ns, whole_ns
from netem.core.settings_section import NonNegative
from noack.settings.values import MatrixRows, require_shape
from noack.trigger_policies.policy_settings import IntervalS, ModelMatrices, WeightedSettings
from noack.trigger_policies.trigger_rule import TriggerRule, quadratic_form


class QuadraticSettings(WeightedSettings):
    """Periodic event-triggered control: at sampling times, transmit when zᵀQz > ε, z = (x, e_s)."""

    policy: Literal["quadratic"]
    Q: MatrixRows
    """Q by rows, 2n x 2n, symmetric."""
    epsilon: NonNegative = 0.0
    """ε."""
    period_s: IntervalS
    """Sampling period; a whole number of the time between measurements."""
    heartbeat: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """Transmit at the latest after this number of periods; 0: no heartbeat."""

    @classmethod
    def example(cls, n: int) -> Self:
        diagonal = np.diag([-0.04] * n + [1.0] * n).tolist()
        Q = tuple(map(tuple, diagonal))
        return cls(policy="quadratic", Q=Q, epsilon=0.0025, period_s=0.05)

    def trigger_policy(self, model: ModelMatrices) -> TriggerRule:
        period_ns = whole_ns(self.period_s)
        return TriggerRule(
            quadratic_form(np.array(self.Q)),
            floor=float(np.sqrt(self.epsilon)),
            grid_ns=period_ns,
            weight=self.weight_matrix,
            longest_ns=self.heartbeat * period_ns if self.heartbeat else math.inf,
        )

    @property
    def description(self) -> str:
        heartbeat = f", or after {self.heartbeat} periods" if self.heartbeat else ""
        return f"zᵀQz > {self.epsilon:g}, sampled every {self.period_s:g} s{heartbeat}"

    def check(self, n: int, why: str) -> None:
        super().check(n, why)
        require_shape(self.Q, "trigger.Q", (2 * n, 2 * n), f"{why}, and z = (x, e_s)")
        Q = np.array(self.Q)
        if not np.allclose(Q, Q.T, rtol=1e-12, atol=0.0):
            raise ValueError("trigger.Q: must be symmetric")

    def check_period(self, measured: Period, key: str = "trigger") -> None:
        period_ns = exact_ns(self.period_s)
        if period_ns % measured.exact:
            raise ValueError(
                f"{key}.period_s: must be a whole number of the {measured.longest_ns / NS_PER_S} s "
                "between measurements"
            )
        if period_ns.denominator > 1:
            raise ValueError(f"{key}.period_s: must be a whole number of nanoseconds")
