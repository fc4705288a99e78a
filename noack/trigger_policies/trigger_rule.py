"""A policy's trigger rule, as data: the form that every policy has.

With z = (x, e_s), the sensor transmits at the first time t after an event at which

    ‖P z‖² > max(c e^{−ρ(t−t₀)}, f)² + ‖N z‖² + η(t),    η̇ = −λη + ‖P_η z‖² − ‖N_η z‖²,

but not while the comparison does not count, on a grid only at its points, and when the next event
is due in any case. A rule that integrates compares ∫‖P z‖dτ, from the last event to t, instead of
‖P z‖.

The live sensor evaluates the rule at its measurements (native/loop/trigger.c): between two of them
it takes ‖P_η z‖² − ‖N_η z‖² as it was at the first, and integrates ‖P z‖ by the trapezoidal rule.
Exact simulation finds the first t (native/exact/).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from netem.core.core_library import CData
from netem.core.core_library import core as network_core
from netem.core.errors import CallerError
from noack.core.core_library import new_handle, new_structure
from noack.core.linear_systems import Matrix, Vector


class QuadraticForm(NamedTuple):
    """The quadratic form ‖P z‖² − ‖N z‖² of z = (x, e_s)."""

    positive: Matrix  # P, shape (p, 2n)
    negative: Matrix  # N, shape (q, 2n); q = 0 for none


class DynamicVariable(NamedTuple):
    """Girard's dynamic variable: η̇ = −λη + ψ(z)."""

    decay_per_s: float  # λ
    gain: QuadraticForm  # ψ
    initial: float = 0.0  # η at the start


class Forecast(NamedTuple):
    """The assumed growth of the sensor's error, and its threshold (:mod:`.self_triggered`)."""

    beta: float  # β > 0
    alpha_per_s: float  # α > 0
    floor: float  # ε ≥ 0
    growth_per_s: float  # L ≥ 0
    mismatch_per_s: float  # a ≥ 0
    disturbance_per_s: float  # b ≥ 0


class TriggerRule(NamedTuple):
    """How each event sets the comparison that decides about the next one."""

    form: QuadraticForm
    """P and N."""
    level: float = 0.0
    """c ≥ 0; it decays from t₀ on."""
    rate_per_s: float = 0.0
    """ρ ≥ 0."""
    floor: float = 0.0
    """f ≥ 0."""
    since_ns: int = 0
    """t₀: 0, or the last change of the rate."""
    decayed: float = 0.0
    """Integral of the rate up to t₀, which c allows for: a change of the rate leaves no jump."""
    from_event: bool = False
    """Instead, t₀ is the event's time, and c is ‖P z‖ just after it."""
    grid_ns: float = 0.0
    """Period of the times at which the comparison counts, from t = 0 on; 0: it always counts."""
    dynamic_variable: DynamicVariable | None = None
    integrates: bool = False
    """Whether ∫‖P z‖dτ since the last event is compared; then N is empty, and there is no η."""
    idle_ns: float = -math.inf
    """The comparison does not count before this time after an event."""
    longest_ns: float = math.inf
    """The next event is due this time after an event; with a forecast, at the latest."""
    shortest_ns: float = 0.0
    """With a forecast: the next event is not due before this time after an event."""
    forecast: Forecast | None = None
    weight: Matrix | None = None
    """W of the norm in which errors are shown, and of the ‖x‖_W that a forecast begins with,
    (n, n); None is the identity."""

    @property
    def is_decaying(self) -> bool:
        """Whether it is the paper's: it compares ‖W e_s‖ with max(c e^{−ρt}, f), and no more."""
        return self.level > 0 and self.idle_ns == -math.inf and self.longest_ns == math.inf

    @property
    def initial_dynamic_variable(self) -> float:
        """η at the start; 0 for a rule without η."""
        return 0.0 if self.dynamic_variable is None else self.dynamic_variable.initial

    @property
    def fading_per_s(self) -> float:
        """α of a threshold that decays from the run's start on; 0 for other thresholds."""
        return 0.0 if self.from_event else self.rate_per_s

    @property
    def largest_threshold(self) -> float:
        """The largest constant that a norm of z is compared with; 0 if there is none."""
        forecast = () if self.forecast is None else (self.forecast.beta, self.forecast.floor)
        return 0.0 if self.integrates else max(self.level, self.floor, *forecast)

    @property
    def least_threshold(self) -> float | None:
        """The threshold of ‖e_s‖_W never falls below this; None: there is no such threshold."""
        if self.forecast is not None:
            return self.forecast.floor
        positive, n = self.form.positive, self.form.positive.shape[1] // 2
        compares = np.array_equal(positive, error_map(n, self.weight)) and not self.grid_ns
        return self.floor if compares and not self.integrates else None

    @property
    def earliest_ns(self) -> float:
        """The first time after an event at which the next one can happen, whatever is measured."""
        if len(self.form.positive):
            earliest_ns = max(self.idle_ns, 0.0)
        else:  # nothing is compared
            earliest_ns = self.longest_ns if self.forecast is None else self.shortest_ns
        return min(earliest_ns, self.longest_ns)

    def latest_ns(self, period_ns: int) -> float:
        """Return the last such time if measurements are a period apart; infinite if none is due."""
        if math.isinf(self.longest_ns):
            return math.inf
        # An event that is due between two measurements happens at the later one.
        return max(math.ceil(self.longest_ns / period_ns), 1) * period_ns

    def threshold(self, t_ns: float) -> float:
        """Return max(c e^{−ρ(t−t₀)}, f)."""
        return max(self.level * math.exp(-self.rate_per_s * (t_ns - self.since_ns) * 1e-9), self.floor)

    def thresholds(self, t_ns: NDArray[np.int64]) -> Vector:
        """Return the threshold at k times, (k,)."""
        decayed = self.level * np.exp(-self.rate_per_s * (t_ns - self.since_ns) * 1e-9)
        return np.asarray(np.maximum(decayed, self.floor))

    def shown_threshold(self, t_ns: float) -> float | None:
        """Return the threshold that depends on time only, or the one that is forecast; None without one."""
        if (forecast := self.forecast) is not None:
            level, rate_per_s, floor = forecast.beta, forecast.alpha_per_s, forecast.floor
            return self._replace(level=level, rate_per_s=rate_per_s, floor=floor).threshold(t_ns)
        is_compared = len(self.form.positive) > 0 and (self.level > 0 or self.floor > 0)
        return None if self.from_event or not is_compared else self.threshold(t_ns)

    def continuing(self, before: "TriggerRule", t_ns: int) -> "TriggerRule":
        """Return this rule, as a change at a time puts it in the place of another one.

        The threshold is c e^{−∫ρ dt}: its new rate counts from the change, and c sets its level.
        """
        decayed, since_ns, t_ns = before.decayed, before.since_ns, max(t_ns, 0)
        if self._fading_per_s != before._fading_per_s:
            decayed += before._fading_per_s * (t_ns - since_ns) * 1e-9
            since_ns = t_ns
        if not decayed:
            return self
        share, forecast = float(network_core.noack_exp(-decayed)), self.forecast
        if forecast is not None:
            forecast = forecast._replace(beta=forecast.beta * share)
        level = self.level if self.from_event else self.level * share
        return self._replace(level=level, forecast=forecast, since_ns=since_ns, decayed=decayed)

    @property
    def _fading_per_s(self) -> float:
        """The rate of the threshold that decays from t₀ on, or of the one that is forecast."""
        return self.fading_per_s if self.forecast is None else self.forecast.alpha_per_s


def error_map(n: int, weight: Matrix | None = None) -> Matrix:
    """[0 W], which takes z to W e_s, shape (n, 2n)."""
    return np.hstack([np.zeros((n, n)), np.eye(n) if weight is None else weight])


def error_form(n: int, weight: Matrix | None = None) -> QuadraticForm:
    """‖W e_s‖²."""
    return QuadraticForm(error_map(n, weight), empty_map(n))


def state_map(n: int, weight: Matrix | None = None) -> Matrix:
    """[W 0], which takes z to W x, shape (n, 2n)."""
    return np.hstack([np.eye(n) if weight is None else weight, np.zeros((n, n))])


def empty_map(n: int) -> Matrix:
    """No rows: the N of a form without one."""
    return np.zeros((0, 2 * n))


def no_form(n: int) -> QuadraticForm:
    """Compare nothing."""
    return QuadraticForm(empty_map(n), empty_map(n))


def quadratic_form(Q: Matrix) -> QuadraticForm:
    """The form zᵀQz of a symmetric matrix, (2n, 2n), as the difference of two squares."""
    values, vectors = np.linalg.eigh(Q)
    rows = np.sqrt(np.abs(values))[:, None] * vectors.T
    return QuadraticForm(rows[values > 0], rows[values < 0])


@dataclass(frozen=True)
class CodedPolicy:
    """A policy that decides by code of its own, and so has no trigger rule."""

    weight: Matrix | None
    new_trigger: Callable[[], "EventTrigger"]  # Returns a trigger that has not started
    why_no_rule: str  # What a user is told where a trigger rule is needed
    fading_per_s: ClassVar = 0.0
    largest_threshold: ClassVar = 0.0
    least_threshold: ClassVar = None
    """As those of a rule; the code's thresholds are not known."""


Policy = TriggerRule | CodedPolicy
"""What decides about events."""


def require_rule(policy: Policy) -> TriggerRule:
    """Return a policy's rule; raise CallerError if it has none."""
    if isinstance(policy, CodedPolicy):
        raise CallerError(policy.why_no_rule)
    return policy


class EventTrigger(Protocol):
    """Decides at measurements by code of its own."""

    def start(self, t_ns: int, x: Vector) -> None:
        """Begin, or begin again after an event."""

    def restart(self, t_ns: int, x: Vector) -> None:
        """Begin after a past event that, as is known only now, has reset the model."""

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> "TriggerDecision":
        """Decide whether a measurement is an event."""


class TriggerDecision(NamedTuple):
    """A policy's decision on a measurement."""

    event: bool
    left: float
    right: float
    """The sides of the comparison; an event if ``left`` exceeds ``right``, or if one is due."""


_LATEST_NS = 2**60
"""The core's longest time; no run is as long."""


def new_rule(rule: TriggerRule, n: int) -> CData:
    """Return a new ``noack_trigger_rule`` for n states.

    Raises:
        ValueError: the rule is for another number of states.
    """
    dynamic, forecast = rule.dynamic_variable, rule.forecast
    numbers: dict[str, object] = {
        "n": n, "level": rule.level, "rate_per_s": rule.rate_per_s, "floor": rule.floor,
        "since_ns": rule.since_ns, "from_event": rule.from_event, "integrates": rule.integrates,
        "is_dynamic": dynamic is not None, "initial": rule.initial_dynamic_variable,
        "decay_per_s": 0.0 if dynamic is None else dynamic.decay_per_s,
        "grid_ns": _whole_ns(rule.grid_ns), "idle_ns": _whole_ns(rule.idle_ns),
        "shortest_ns": _whole_ns(rule.shortest_ns), "longest_ns": _whole_ns(rule.longest_ns),
        "forecasts": forecast is not None, "weight": rule.weight,
    }  # fmt: skip
    if forecast is not None:
        thresholds = forecast._asdict()
        numbers |= {"forecast_weight": rule.weight, "forecast_floor": thresholds.pop("floor")} | thresholds
    for suffix, form in (("", rule.form), ("_gain", None if dynamic is None else dynamic.gain)):
        for name, matrix in () if form is None else form._asdict().items():
            if matrix.shape[1] != 2 * n:
                raise ValueError(f"trigger: expected {2 * n} columns, found {matrix.shape[1]}")
            rows = len(matrix)
            numbers |= {f"{name}{suffix}": matrix if rows else None, f"{name}{suffix}_rows": rows}
    return new_handle("trigger_rule", new_structure("noack_trigger_rule", numbers))


def _whole_ns(t_ns: float) -> int:
    """Return the first whole number from ``t_ns`` on: times of measurements are whole."""
    return math.ceil(min(max(t_ns, -_LATEST_NS), _LATEST_NS))
