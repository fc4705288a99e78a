"""Self-triggered control: at each event the sensor says when the next one is, and sleeps.

It assumes d‖e_s‖_W/dt ≤ L‖e_s‖_W + a‖x(t_k)‖_W + b between events, so that

    ‖e_s(t_k + τ)‖_W ≤ (a‖x(t_k)‖_W + b) (e^{Lτ} − 1)/L,

and transmits when this bound reaches max(βe^{−α(t_k+τ)}, ε), though within [τ_min, τ_max]. Where
the assumption holds, and τ_min has not delayed it, ‖e_s‖_W stays below the paper's threshold
without being watched. (The idea is that of Anta & Tabuada, IEEE TAC 55(9), 2010; the bound is
Gronwall's.)
"""

import math
from dataclasses import dataclass

import numpy as np

from noack.linear import Matrix, Vector
from noack.trigger.guard import Form, Guard, nothing

_HALVINGS = 80


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
    first_reserve = 0.0

    def guard(self, t_ns: float, x: Vector) -> Guard:
        """The time of the next event, from the state at this one."""
        form = Form(nothing(len(x)), nothing(len(x)))
        return Guard(form, latest_ns=t_ns + self._interval_ns(t_ns * 1e-9, x))

    def _interval_ns(self, t_s: float, x: Vector) -> float:
        size = float(np.linalg.norm(x if self.weight is None else self.weight @ x))
        speed, L = self.mismatch_per_s * size + self.disturbance_per_s, self.growth_per_s

        def reached(tau_s: float) -> bool:
            exponent = min(L * tau_s, 700.0)
            # The first two terms of the series where the third is below rounding.
            grown = math.expm1(exponent) / L if exponent > 1e-8 else tau_s * (1 + exponent / 2)
            faded = self.beta * math.exp(-self.alpha_per_s * (t_s + tau_s))
            return speed * grown >= max(faded, self.floor)

        low_s, high_s = self.shortest_ns * 1e-9, self.longest_ns * 1e-9
        if reached(low_s):
            return self.shortest_ns
        if not reached(high_s):
            return self.longest_ns
        # The left side grows and the right one does not: they meet once.
        for _ in range(_HALVINGS):
            middle_s = (low_s + high_s) / 2
            low_s, high_s = (low_s, middle_s) if reached(middle_s) else (middle_s, high_s)
        return math.floor(low_s * 1e9)
