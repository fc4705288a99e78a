"""The trigger rules of the reference loop, as docs/scenarios.md states them; for sampled time.

A rule is the table of a scenario: ``{"policy": "absolute", "delta": 0.1}``. At a measurement it
compares two sides; the sensor transmits if the left one is larger, or if an event is due. A rule
zᵀQz > c of z = (x, e_s) has the sides ‖Pz‖ and √(c + ‖Nz‖²), with Q = PᵀP − NᵀN.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.linalg import norm

Array = np.ndarray[Any, np.dtype[np.float64]]
Rule = Mapping[str, Any]


class Trigger:
    """A rule since the last event, which reset the model to x_k at t_k; F is Â + B̂K."""

    def __init__(self, rule: Rule, F: Array, BK: Array) -> None:
        self.F, self.BK = F, BK
        self.faded, self.faded_until_ns = 0.0, 0  # ∫α dt
        self.base: Rule = {}
        self.use(rule, 0)
        self.y = self.base.get("eta_0", 0.0)  # η of "dynamic"; the integral of "send_on_area"
        self.rate = 0.0  # dy/dt at the last measurement
        self.measured_ns = 0

    def use(self, rule: Rule, since_ns: int) -> None:
        """Use a rule, or other numbers of it, as if it had been in force at the last event.

        A threshold that decays keeps what it has decayed by until the change.
        """
        self.faded += self.base.get("alpha_per_s", 0.0) * (since_ns - self.faded_until_ns) * 1e-9
        self.faded_until_ns = since_ns
        self.rule = self.base = rule
        while "rule" in self.base:  # of "deadline" and "dwell"
            self.base = self.base["rule"]
        eye = np.eye(len(self.F))
        self.W = np.array(self.base.get("weight", eye))
        if self.base["policy"] in ("lyapunov", "dynamic"):  # FᵀP + PF = −Q
            Q = np.array(self.base.get("Q", eye))
            equations = np.kron(self.F.T, eye) + np.kron(eye, self.F.T)
            self.P = np.linalg.solve(equations, -Q.ravel()).reshape(Q.shape)
        if self.base["policy"] == "dynamic":  # w = σ xᵀQx − 2 xᵀPBK e_s
            PBK = self.P @ self.BK
            self.w = np.block([[self.base["sigma"] * Q, -PBK], [-PBK.T, 0 * Q]])

    def event(self, t_ns: int, x: Array) -> None:
        """Begin again: the model has been reset to the state x of the time t_ns."""
        self.t_k_ns, self.x_k = t_ns, x
        if self.base["policy"] == "send_on_area":
            self.y = self.rate = 0.0

    def measured(self, t_ns: int, x: Array, e_s: Array) -> None:
        """Advance y to a measurement."""
        z, dt_s, rate = np.concatenate([x, e_s]), (t_ns - self.measured_ns) * 1e-9, self.rate
        self.measured_ns = t_ns
        if self.base["policy"] == "send_on_area":  # trapezoids of ‖e_s‖
            self.rate = float(norm(self.W @ e_s))
            self.y += dt_s * (rate + self.rate) / 2
        if self.base["policy"] == "dynamic":  # dη/dt = −λη + w, with w as at the last measurement
            decay = self.base["decay_per_s"]
            self.rate = float(z @ self.w @ z)
            gain = -math.expm1(-decay * dt_s) / decay if decay else dt_s
            self.y = math.exp(-decay * dt_s) * self.y + gain * rate

    def sides(self, t_ns: int, x: Array, e_s: Array) -> tuple[float, float]:
        """Return both sides of the comparison."""
        rule, e, z = self.base, float(norm(self.W @ e_s)), np.concatenate([x, e_s])
        match rule["policy"]:
            case "decaying":
                return e, threshold(rule, (t_ns - self.faded_until_ns) * 1e-9, self.faded)
            case "absolute":
                return e, rule["delta"]
            case "relative" | "mixed":
                return e, math.hypot(rule["sigma"] * norm(self.W @ x), rule.get("epsilon", 0.0))
            case "quadratic":
                return form_sides(np.array(rule["Q"]), z, rule["epsilon"])
            case "lyapunov":  # V(x) = xᵀPx and its envelope, as square roots
                fade = math.exp(-rule["rate_per_s"] / 2 * (t_ns - self.t_k_ns) * 1e-9)
                return math.sqrt(x @ self.P @ x), fade * math.sqrt(self.x_k @ self.P @ self.x_k)
            case "dynamic":  # η + θw ≤ 0; an η below 0 counts as 0
                return form_sides(-rule["theta_s"] * self.w, z, max(self.y, 0.0))
            case "send_on_area":
                return self.y, rule["delta_s"]
            case "periodic" | "self_triggered":  # nothing is compared
                return 0.0, 0.0
        raise ValueError(rule["policy"])

    def counts(self, t_ns: int, rule: Rule) -> bool:
        """Whether the comparison counts: on the grid of "quadratic", after a dwell time."""
        inner = self.counts(t_ns, rule["rule"]) if "rule" in rule else True
        match rule["policy"]:
            case "quadratic":
                return t_ns % whole_ns(rule["period_s"]) == 0
            case "dwell":
                return inner and t_ns - self.t_k_ns >= whole_ns(rule["interval_s"])
        return inner

    def due_ns(self, rule: Rule) -> float:
        """Return when the next event happens whatever the comparison says."""
        inner = self.due_ns(rule["rule"]) if "rule" in rule else math.inf
        match rule["policy"]:
            case "periodic":
                return self.t_k_ns + whole_ns(rule["period_s"])
            case "quadratic" if rule["heartbeat"]:
                return self.t_k_ns + rule["heartbeat"] * whole_ns(rule["period_s"])
            case "self_triggered":
                size = float(norm(self.W @ self.x_k))
                return self.t_k_ns + reach_ns(
                    rule, (self.t_k_ns - self.faded_until_ns) * 1e-9, size, self.faded
                )
            case "deadline":
                return min(inner, self.t_k_ns + whole_ns(rule["interval_s"]))
            case "dwell":
                return max(inner, self.t_k_ns + whole_ns(rule["interval_s"]))
        return inner


def threshold(rule: Rule, t_s: float, faded: float = 0.0) -> float:
    """max(β e^(−αt), ε), t after a change up to which ∫α dt was ``faded``."""
    return max(rule["beta"] * math.exp(-faded - rule["alpha_per_s"] * t_s), rule["floor"])


def form_sides(Q: Array, z: Array, level: float) -> tuple[float, float]:
    """Return both sides of zᵀQz > level."""
    values, vectors = np.linalg.eigh(Q)
    squares = abs(values) * (vectors.T @ z) ** 2
    return math.sqrt(squares[values > 0].sum()), math.sqrt(level + squares[values < 0].sum())


def reach_ns(rule: Rule, t_k_s: float, size: float, faded: float) -> float:
    """Return the first τ with (a‖x_k‖ + b)(e^(Lτ) − 1)/L ≥ the threshold, within its limits."""
    growth, speed = rule["growth_per_s"], rule["mismatch_per_s"] * size + rule["disturbance_per_s"]

    def reached(tau_s: float) -> bool:
        grown = math.expm1(growth * tau_s) / growth if growth else tau_s
        return speed * grown >= threshold(rule, t_k_s + tau_s, faded)

    low_s, high_s = rule["shortest_s"], rule["longest_s"]
    if reached(low_s) or not reached(high_s):
        return whole_ns(low_s if reached(low_s) else high_s)
    for _ in range(60):  # bisection
        middle_s = (low_s + high_s) / 2
        low_s, high_s = (low_s, middle_s) if reached(middle_s) else (middle_s, high_s)
    return high_s * 1e9


def whole_ns(seconds: float) -> int:
    """Return a time in nanoseconds."""
    return round(seconds * 1e9)
