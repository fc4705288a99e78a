"""Computes the times at which a trigger rule's comparison is active, and its threshold.

The numbers are those of :class:`noack.trigger.trigger_rule.TriggerRule`, with the same meaning.
"""

import math
from typing import NamedTuple

from noack.trigger.self_triggered_interval import Forecast, interval_ns
from noack.trigger.trigger_rule import TriggerRule

_GRID_SLACK = 1e-9
"""Tolerance for an event's time on the grid, as a share of the period (see ``continuous_loop``)."""
_NS = 1e-9
_PER_S = 1e9


class Rule(NamedTuple):
    """The numbers of a trigger rule; its forms are in ``quadratic_crossing``."""

    compares: bool
    """Whether there is a form."""
    integrates: bool
    level: float
    rate_per_s: float
    floor: float
    from_event: bool
    grid_s: float
    idle_ns: float
    longest_ns: float
    shortest_ns: float
    forecasts: bool
    forecast: Forecast


def rule_of(rule: TriggerRule) -> Rule:
    """Return the numbers of a trigger rule."""
    return Rule(
        compares=len(rule.form.up) > 0,
        integrates=rule.integrates,
        level=float(rule.level),
        rate_per_s=float(rule.rate_per_s),
        floor=float(rule.floor),
        from_event=rule.from_event,
        grid_s=rule.grid_ns * _NS,
        idle_ns=float(rule.idle_ns),
        longest_ns=float(rule.longest_ns),
        shortest_ns=float(rule.shortest_ns),
        forecasts=rule.forecast is not None,
        forecast=Forecast(*map(float, rule.forecast or (0.0,) * len(Forecast._fields))),
    )


class Span(NamedTuple):
    """The rule between two events; times in seconds since the run's start."""

    since_s: float
    """t₀."""
    level: float
    """c."""
    floor_from_s: float
    """From this time on, the floor is the threshold."""
    begin_s: float
    """The comparison is active from this time on."""
    due_s: float
    """Time of the next event that the rule forces."""
    point: int
    """Number of the next grid point."""


def span_after(rule: Rule, t_s: float, left: float, size: float) -> Span:
    """Return the rule's span after an event or after the start at ``t_s``.

    ``left`` is ‖P z‖ just after it (for rules ``from_event``), ``size`` ‖x‖_W (for forecasts).
    """
    level, since_s, due_ns, point = rule.level, 0.0, rule.longest_ns, 0
    if rule.from_event:
        level, since_s = left, t_s
    if rule.forecasts:
        due_ns = interval_ns(rule.forecast, size, t_s, rule.shortest_ns, rule.longest_ns)
    floor_from_s = -math.inf
    if level > rule.floor:
        floor_from_s = math.inf
        if rule.floor > 0.0 and rule.rate_per_s > 0.0:
            floor_from_s = since_s + math.log(level / rule.floor) / rule.rate_per_s
    # In integer nanoseconds like the rule, so that an event at the horizon is the same everywhere.
    due_s = (t_s * _PER_S + due_ns) * _NS
    begin_s = min((t_s * _PER_S + rule.idle_ns) * _NS, due_s)
    if rule.grid_s > 0.0:
        point = math.floor(t_s / rule.grid_s + _GRID_SLACK) + 1
        if begin_s > t_s:
            point = max(point, math.ceil(begin_s / rule.grid_s - _GRID_SLACK))
    return Span(since_s, level, floor_from_s, begin_s, due_s, point)


class Phase(NamedTuple):
    """An interval in which the form of the comparison and of its threshold does not change."""

    until_s: float
    """Its end."""
    compares: bool
    """Whether the comparison is active."""
    threshold: float
    """Threshold at the start of the phase; 0 if there is none."""
    rate_per_s: float
    """Decay rate of the threshold."""


def phase_at(rule: Rule, span: Span, t_s: float) -> Phase:
    """Return the phase that starts at ``t_s``."""
    if t_s < span.begin_s:
        return Phase(span.begin_s, False, 0.0, 0.0)
    if not rule.compares:
        return Phase(span.due_s, False, 0.0, 0.0)
    if t_s < span.floor_from_s:
        threshold = span.level * math.exp(-rule.rate_per_s * (t_s - span.since_s))
        return Phase(min(span.due_s, span.floor_from_s), True, threshold, rule.rate_per_s)
    return Phase(span.due_s, True, rule.floor, 0.0)


def last_point(rule: Rule, t_s: float) -> int:
    """Return the last grid point up to a time."""
    return math.floor(t_s / rule.grid_s + _GRID_SLACK)


def threshold_after(phase: Phase, s: float) -> float:
    """Return the threshold ``s`` seconds after the start of a phase."""
    if phase.rate_per_s > 0.0:
        return phase.threshold * math.exp(-phase.rate_per_s * s)
    return phase.threshold
