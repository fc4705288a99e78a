"""Bounds of e_c after lost events, by the flow from the last delivery.

Without the flow, each missing event adds its ‖e_s‖_W in full, as if all had one direction. But
until the next delivery everything follows from z at one time (``delivery_flow.py``). Let an event
be lost at least w after the delivery, and ‖e_c‖_W ≤ D up to it. z is the value w before it, z' =
e^{Fw} z:

    ‖Λx‖ ≤ c and ‖e_c‖ ≤ D at z and z',  ‖e_s‖ = ‖C_r z'‖ ≤ β for r until the next event

With positive weights of sum 1, z is in the ellipsoid of the sum of these forms, which bounds e_c =
(0, I) e^{Fr} z' after r (``ellipsoid_intersections.py``).

After an event e_s begins at 0, so the same forms bound the time until the next event, too.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector, exponential
from noack.theory.bounds.enclosure import KernelBounds, response_until
from noack.theory.bounds.gains import Output
from noack.theory.bounds.stacked_norms import Stack, larger_ends
from noack.theory.certificates.deliveries.delivery_flow import FLOW_ROUNDING, bend_rows, bend_terms
from noack.theory.certificates.deliveries.delivery_reach import Reach
from noack.theory.certificates.deliveries.ellipsoid_intersections import Wanted, bound_outputs

_FIRST_NODES = np.linspace(0.0, 1.0, 20).tolist()
"""First nodes of r, in units of δ; no event comes before the last of them."""
_NODE_RATIO, _MOST_NODES = 1.03, 300
"""Ratio from one node to the next one after these, and the most nodes: r is up to 4000 δ."""
_LATEST = 6.0
"""Largest r in units of δ at which events are looked for; a limit of the work."""
_DECAYED = 0.6
"""‖e^{(H+αI)r}‖_W at the last r, if possible: from there on the bound without the flow is used."""
_NEARLY_SUMMED = 0.999
"""Share of the bound without the flow from which on nothing is gained."""
_ERROR_AT_DELIVERY = 1e-3
"""Bound of ‖e_c‖ at a delivery, as a share of that of e_s: it is 0 there, but is divided by."""
_TAYLOR_TERMS = 8
"""Terms by which e_c'' over a cell is bounded; cells may be longer here than those of the flow."""


class SensorErrors(NamedTuple):
    """Bounds of ‖e_s‖_W between two events."""

    after_losses: Vector
    """Its bounds, while 0, 1, … events have been lost since the delivery."""
    after_test: float
    """Its bound after a test; infinite if there is none."""
    first_test_s: float
    """The first test is that long after an event."""
    grid_s: float
    """Tests are multiples of this after an event; 0 if the trigger is tested at all times."""
    level: float
    """The least ‖e_s‖_W at an event, or its least integral if that is compared; 0 if nothing is known."""
    integrates: bool
    """Whether its integral since the event is compared."""
    earliest_due_s: float
    """The earliest time after an event at which the next one may be due, whatever e_s is."""

    def since_event(self, r_s: Vector, lost: int) -> Vector:
        """Bound ‖e_s‖_W at times after an event, while ``lost`` events have been lost, (k,)."""
        tested = np.where(r_s * FLOW_ROUNDING >= self.first_test_s, self.after_test, math.inf)
        return np.asarray(np.minimum(tested, self.after_losses[lost]))


def errors_after_losses(
    reach: Reach,
    without_flow: Vector,
    sensor: SensorErrors,
    outputs: Sequence[Matrix],
    inter_event_s: float,
    bend: float,
) -> tuple[Vector, float]:
    """Bound ‖e_c‖_W while at most 0, 1, … events have been lost since the delivery.

    Args:
        reach: the flow from a delivery; it is invariant.
        without_flow: bounds without the flow, for 0, 1, … events.
        sensor: bounds of e_s.
        outputs: matrices Y with ‖Y z‖ ≤ 1 at all times.
        inter_event_s: a known lower bound of the inter-event time.
        bend: that of e_s, see :func:`bend_of_error`.

    Returns:
        The bounds, and a lower bound of the inter-event time, at least ``inter_event_s``.
    """
    flow = reach.ellipsoid.flow
    errors = without_flow.copy()
    most_s = float(flow.edges_s[-1]) / 4  # e^{Fτ} is accurate until 4 times as late
    if inter_event_s >= most_s or len(without_flow) == 1:
        return errors, inter_event_s
    # The nodes r after an event, and e^{Fr}.
    kernel = flow.error.kernels[Output.WEIGHTED]
    r_s = _nodes_s(inter_event_s, kernel, 2 * most_s, sensor.grid_s)
    flows = np.array([exponential(flow.generator * time_s) for time_s in r_s.tolist()])
    first_event_s = float(flow.edges_s[reach.first_cell]) if reach.first_cell else math.inf
    # The delivery, then one lost event after the other.
    since_delivery_s = -reach.effects.acts_within_s
    implied_s = math.inf
    state_bound = reach.scale
    for lost, sensor_error in enumerate(sensor.after_losses.tolist()):
        at_delivery = max(_ERROR_AT_DELIVERY * sensor_error, reach.effects.first_error)
        error_before = float(errors[lost - 1]) if lost else at_delivery
        window_s = min(max(since_delivery_s, 0.0), most_s)
        event = _SinceEvent(reach, window_s, error_before, state_bound, outputs, r_s, flows)
        if lost:  # e_c until the next delivery, if at most this many events are lost
            summed = sensor_error + kernel.sups(r_s) * error_before
            largest = event.largest_error(sensor.since_event(r_s, lost), summed)
            errors[lost] = min(without_flow[lost], largest)
            if lost > 1 and errors[lost] > _NEARLY_SUMMED * float(summed[0]):
                return errors, inter_event_s  # after more losses nothing is gained, either
        later_s = event.next_event_s(sensor, bend, inter_event_s, is_delivered=not lost)
        since_delivery_s += later_s
        if not lost:  # x(0) itself may be outside the ellipsoid
            since_delivery_s = min(since_delivery_s, first_event_s)
            later_s = max(min(later_s, first_event_s), inter_event_s)
            state_bound = reach.largest_state(first_event_s - since_delivery_s)
        implied_s = min(implied_s, later_s)
    return errors, implied_s


def bend_of_error(reach: Reach, level: float) -> float:
    """Bound the second derivative of e_s while ‖e_s‖_W is below a level."""
    flow = reach.ellipsoid.flow
    return reach.sup(bend_rows(flow)) + float(np.linalg.norm(flow.H @ flow.H, 2)) * level


def _nodes_s(inter_event_s: float, kernel: KernelBounds, most_s: float, grid_s: float) -> Vector:
    """Return times r, if possible up to one at which ‖e^{(H+αI)r}‖_W has fallen below a value."""
    nodes_s = [inter_event_s * share for share in _FIRST_NODES]
    while len(nodes_s) < _MOST_NODES and kernel.sup(nodes_s[-1]) > _DECAYED:
        nodes_s.append(nodes_s[-1] * _NODE_RATIO)
    r_s = np.array([time_s for time_s in nodes_s if time_s <= most_s])
    return grid_s * np.unique(np.rint(r_s / grid_s)) if grid_s else r_s


class _SinceEvent:
    """Bounds at times r since an event that is a time w or more after the delivery.

    z is e^{Fw} ζ at the event. What q has changed since some time before is bounded with e^{−Fs} (BU, −BU).
    Up to the event ‖e_c‖_W ≤ ``error_before`` and ‖Λx‖ ≤ ``state_bound``. ``flows`` are e^{Fr}.
    """

    def __init__(
        self,
        reach: Reach,
        window_s: float,
        error_before: float,
        state_bound: float,
        outputs: Sequence[Matrix],
        r_s: Vector,
        flows: Stack,
    ) -> None:
        self._flow = flow = reach.ellipsoid.flow
        self._r_s = r_s
        self._error_before = error_before
        self._age_input = reach.effects.age_input
        self._acts_within_s = reach.effects.acts_within_s
        self._first_error = reach.effects.first_error
        n, scaling, identity = flow.n, reach.ellipsoid.scaling, np.eye(2 * flow.n)
        to_event = exponential(flow.generator * window_s)
        # What q changes after the event, and has changed before it.
        by_input = flow.error_effects[1][[flow.cell_at(time_s) for time_s in r_s.tolist()]]
        self._input_changes = self._age_input * by_input if self._age_input else np.zeros(len(r_s))
        error_change = self._age_input * self._input_response_before(identity[n:, n:], window_s)
        state_change = self._age_input * self._input_response_before(scaling, window_s)
        # Forms of z a time w before the event: of bounds there, at the event, and of its outputs.
        rows = [
            identity[n:] / (error_before + error_change),
            scaling @ identity[:n] / (state_bound + state_change),
            to_event[n:] / error_before,
            scaling @ to_event[:n] / state_bound,
            *(Y @ to_event for Y in outputs),
        ]
        forms = np.array([row.T @ row for row in rows])
        self._forms = np.broadcast_to(forms, (len(r_s), *forms.shape))
        self._z = flows @ to_event
        # x + e_c follows the models: e^{Hr} is the sum of both rows of e^{Fr} (I, 0).
        models = flows[:, :n, :n] + flows[:, n:, :n]
        self._e_s = self._z[:, n:] - models @ to_event[n:]

    def _input_response_before(self, C: Matrix, ago_s: float) -> float:
        """Bound ∫ ‖C e^{−As} BU‖ ds over some time; (I, 0) e^{−Fs} (BU, −BU) = e^{−As} BU."""
        if not (self._age_input and ago_s):
            return 0.0
        flow = self._flow
        responses = response_until(flow.BK - flow.closed_loop, flow.input_matrix, ago_s)
        return float(responses.through(C).integral_on_grid())

    def largest_error(self, sensor_errors: Vector, summed: Vector) -> float:
        """Bound ‖e_c‖_W from the event on, given bounds of e_s, and of e_c without the flow, at each r."""
        # No event has happened before the next node.
        squares = (sensor_errors + self._input_changes)[:-1, None, None] ** 2
        no_events = (self._e_s.swapaxes(1, 2) @ self._e_s)[:-1] / squares
        forms = np.concatenate([self._forms[:-1], no_events[:, None]], axis=1)
        # Up to the last node by the flow, then without it.
        cap = summed[:-1] - self._input_changes[1:]
        ends, weights = bound_outputs(forms, self._z[1:, self._flow.n :], float(summed[-1]), cap=cap)
        cells = np.maximum(ends, np.append(self._error_before, ends[:-1])) + self._sags(forms, weights)
        until_last = float(np.minimum(cells + self._input_changes[1:], summed[:-1]).max())
        return max(until_last, float(summed[-1]), self._error_before)

    def _sags(self, forms: Stack, weights: Stack) -> Vector:
        """Bound how much e_c differs from its chord in each cell of r."""
        steps_s = np.diff(self._r_s)
        inverse = np.linalg.inv(np.einsum("ji,jiab->jab", weights, forms))
        terms, remainder = bend_terms(self._flow.generator, self._z[:-1], steps_s, _TAYLOR_TERMS)
        bends = np.zeros(len(steps_s))
        # e_c of Taylor's terms, and the whole remainder.
        for rows in (*(term[:, self._flow.n :] for term in terms), remainder):
            bends += np.sqrt(np.abs(np.einsum("jab,jbc,jac->j", rows, inverse, rows)))
        return np.asarray(steps_s**2 / 8 * bends * FLOW_ROUNDING)

    def next_event_s(
        self, sensor: SensorErrors, bend: float, inter_event_s: float, *, is_delivered: bool
    ) -> float:
        """Return a time before which there is no other event, at least ``inter_event_s``."""
        flow, most_s = self._flow, min(_LATEST * inter_event_s, sensor.earliest_due_s)
        # After a delivery e_s is at most ‖e^{(H+αI)r}‖ · first_error larger than C_r z.
        late_error = flow.model_growth * self._first_error if is_delivered else 0.0
        level = sensor.level - (late_error * self._acts_within_s if sensor.integrates else late_error)
        if level <= 0:
            return inter_event_s
        if self._age_input:  # what is followed differs from e_s
            by_input = flow.unit_effects(bend_rows(flow))[1][flow.cell_at(most_s)]
            difference = float(np.linalg.norm(flow.H @ flow.H, 2)) * float(self._input_changes.max())
            bend = bend + self._age_input * float(by_input) + difference
        # e_s over each cell.
        is_near = self._r_s <= most_s
        enough, most = (0.0, math.inf) if sensor.integrates else (0.9 * level, level)
        forms, e_s = self._forms[is_near], self._e_s[is_near]
        ends, _ = bound_outputs(forms, e_s, enough, wanted=Wanted.ALL, most=most)
        steps_s = np.diff(self._r_s[is_near])
        cells = larger_ends(ends) + steps_s**2 / 8 * bend + self._input_changes[1:][is_near[1:]]
        if sensor.integrates:
            cells = np.cumsum(steps_s * (np.maximum.accumulate(cells) + late_error))
        reached_s = float(self._r_s[np.append(cells >= level, True).argmax()])
        # Tests may lie beside the nodes if times are not those since an event.
        if late_error and sensor.integrates:
            reached_s -= sensor.grid_s
        return max(inter_event_s, reached_s)
