"""The sensor: its model x_s, and events exactly where the trigger's rule has them.

The rule is data (:mod:`noack.trigger_policies.trigger_rule`); this is its definition again, with
numpy. Where the two sides of a comparison differ by no more than rounding, the recorded decision
counts.
"""

import math

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT
from noack.scenario.resolution import policy_of
from noack.trigger_policies.trigger_rule import Forecast, TriggerRule
from tests.oracles.explained_run.findings import ExplainedLoop, is_moderate

MODEL, TRIGGER = "sensor's model", "trigger"
_NEAR = 1e-8
"""Sides of a comparison that differ by less, relatively, are taken as equal."""
_FORECAST_NS = 1000
"""Rounding of the time that a forecast gives."""


def check_events(run: ExplainedLoop) -> None:
    """Check x_s at each measurement, and whether it is an event."""
    if run.scenario.protocol.acknowledges:
        return  # x_s then depends on acknowledgements, about which nothing is stated
    policy, knows_start = policy_of(run.scenario), run.scenario.network.initial_sync == "known_state"
    rule = policy if isinstance(policy, TriggerRule) else None
    guard = None if rule is None else _Guard(rule)
    x_s, model_ns, events = (run.loop.known_x0, 0, 0) if knows_start else (None, 0, 0)
    if guard is not None and knows_start:
        guard.start(0, _from_reference(run, 0, run.loop.known_x0))
    for number, row in enumerate(run.rows(SENSOR_MEASUREMENT)):
        t_ns, x = int(row["t_ns"]), row["x"]
        if row["sequence"] != number or not is_moderate(x, row["x_s"]):
            return  # rows are missing, or the run diverges
        expected = x if x_s is None else run.flow(x_s, model_ns, t_ns)
        if not run.is_near(row["x_s"], expected, x):
            run.add(t_ns, MODEL, f"x_s = {row['x_s']}, but its model leads to {expected}")
        is_event, first = int(row["event"]) != NO_SEQUENCE, x_s is None
        decided = _decision(run, guard, row, first=first)
        if decided is not None and decided != is_event:
            sides = f"compared {row['compared']}, threshold {row['threshold']}"
            what = "no event, but the rule has one" if decided else "an event, but the rule has none"
            run.add(t_ns, TRIGGER, f"{what}; {sides}")
        if is_event and row["event"] != events:
            run.add(t_ns, TRIGGER, f"event {row['event']} follows {events - 1}")
        events += is_event
        if is_event and guard is not None:
            guard.start(t_ns, _from_reference(run, t_ns, x))
        x_s, model_ns = x if is_event else row["x_s"], t_ns


def _decision(run: ExplainedLoop, guard: "_Guard | None", row: np.void, *, first: bool) -> bool | None:
    """Return whether a measurement must be an event; None where rounding decides."""
    if guard is None:  # a user's class
        return True if first else bool(row["compared"] > row["threshold"])
    t_ns = int(row["t_ns"])
    deviation = _from_reference(run, t_ns, row["x"])
    if first:
        guard.start(t_ns, deviation)
    decided = guard.test(t_ns, deviation, row["x_s"] - row["x"])
    return True if first else decided


def _from_reference(run: ExplainedLoop, t_ns: int, x: Vector) -> Vector:
    return np.asarray(x - run.point(t_ns)[: len(x)])


class _Guard:
    """The comparison that decides about the next event."""

    def __init__(self, rule: TriggerRule) -> None:
        self.rule = rule
        self.auxiliary = rule.initial_dynamic_variable
        self._scale = abs(self.auxiliary)
        """Size of what the auxiliary variable is a sum of."""
        self._rate = self._rate_scale = 0.0
        self._measured_ns = self._event_ns = 0
        self._level, self._since_ns, self._latest_ns = rule.level, rule.since_ns, math.inf
        self._is_forecast = False

    def start(self, t_ns: int, x: Vector) -> None:
        """Set the comparison at the start of a run, or after an event, at x."""
        rule = self.rule
        self._event_ns, self._level, self._since_ns = t_ns, rule.level, rule.since_ns
        if rule.from_event:
            self._level = _size(rule.form.positive, np.append(x, np.zeros(len(x))))
            self._since_ns = t_ns
        self._latest_ns, self._is_forecast = t_ns + rule.longest_ns, False
        if rule.forecast is not None:
            size = float(np.linalg.norm(x if rule.weight is None else rule.weight @ x))
            after_s, self._is_forecast = _forecast_s(rule, rule.forecast, size, (t_ns - rule.since_ns) * 1e-9)
            self._latest_ns = t_ns + after_s * 1e9
        if rule.integrates:
            self.auxiliary = self._scale = 0.0
        self._measured_ns = t_ns
        self._rate, self._rate_scale = self._rate_at(np.append(x, np.zeros(len(x))))

    def test(self, t_ns: int, x: Vector, e_s: Vector) -> bool | None:
        """Return whether a measurement is an event by the rule; None where rounding decides."""
        rule, z = self.rule, np.append(x, e_s)
        self._advance(t_ns, z)
        if self._is_forecast and abs(t_ns - self._latest_ns) <= _FORECAST_NS:
            return None
        if t_ns >= self._latest_ns:
            return True
        on_grid = rule.grid_ns == 0 or t_ns % int(rule.grid_ns) == 0
        if t_ns < self._event_ns + rule.idle_ns or not on_grid or not len(rule.form.positive):
            return False
        threshold = max(self._level * math.exp(-rule.rate_per_s * (t_ns - self._since_ns) * 1e-9), rule.floor)
        if rule.integrates:
            return _compare(self.auxiliary, threshold, self._scale)
        left = _size(rule.form.positive, z) ** 2
        right = [threshold**2, _size(rule.form.negative, z) ** 2, max(self.auxiliary, 0.0)]
        # A form that is given by Q is split by its eigenvectors: rounding is that of its largest terms.
        largest = float(np.abs(rule.form.positive).max(initial=0.0)) ** 2 * float(z @ z)
        return _compare(left, sum(right), max(left, *right, self._scale, largest * 1e-6))

    def _advance(self, t_ns: int, z: Vector) -> None:
        """Integrate the auxiliary variable up to a measurement, as the sensor does."""
        rule, dt_s = self.rule, (t_ns - self._measured_ns) * 1e-9
        before, scale_before = self._rate, self._rate_scale
        self._rate, self._rate_scale = self._rate_at(z)
        self._measured_ns = t_ns
        if rule.integrates:
            self.auxiliary += dt_s * (before + self._rate) / 2
            self._scale += dt_s * (scale_before + self._rate_scale) / 2
        elif rule.dynamic_variable is not None:
            decay = rule.dynamic_variable.decay_per_s
            gained_s = -math.expm1(-decay * dt_s) / decay if decay > 0 else dt_s
            self.auxiliary = self.auxiliary * math.exp(-decay * dt_s) + gained_s * before
            self._scale = self._scale * math.exp(-decay * dt_s) + gained_s * scale_before

    def _rate_at(self, z: Vector) -> tuple[float, float]:
        """Return the rate of the auxiliary variable, and the size of its terms."""
        if self.rule.integrates:
            size = _size(self.rule.form.positive, z)
            return size, size
        if self.rule.dynamic_variable is None:
            return 0.0, 0.0
        gain = self.rule.dynamic_variable.gain
        plus, minus = _size(gain.positive, z) ** 2, _size(gain.negative, z) ** 2
        return plus - minus, plus + minus


def _compare(left: float, right: float, scale: float) -> bool | None:
    """Return whether the left side is larger; None if rounding decides."""
    return None if scale > 0 and abs(left - right) <= _NEAR * scale else left > right


def _size(M: Matrix, z: Vector) -> float:
    return float(np.linalg.norm(M @ z)) if len(M) else 0.0


def _forecast_s(rule: TriggerRule, forecast: Forecast, size: float, t_s: float) -> tuple[float, bool]:
    """Return after which time the next event is due, and whether it is not one of the two limits."""
    L, speed = forecast.growth_per_s, forecast.mismatch_per_s * size + forecast.disturbance_per_s

    def exceeds(tau_s: float) -> bool:
        growth_s = math.expm1(min(L * tau_s, 700.0)) / L if L > 0 else tau_s
        threshold = forecast.beta * math.exp(-forecast.alpha_per_s * (t_s + tau_s))
        return speed * growth_s >= max(threshold, forecast.floor)

    low_s, high_s = rule.shortest_ns * 1e-9, rule.longest_ns * 1e-9
    if exceeds(low_s):
        return low_s, True
    if not exceeds(high_s):
        return high_s, True
    for _ in range(100):
        middle_s = (low_s + high_s) / 2
        low_s, high_s = (low_s, middle_s) if exceeds(middle_s) else (middle_s, high_s)
    return low_s, True
