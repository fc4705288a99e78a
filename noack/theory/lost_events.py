"""Bounds ‖e_c‖_W after lost events by what the flow between two deliveries allows.

Without the flow, each missing event adds its ‖e_s‖_W in full, as if all had one direction. But
until the next delivery everything follows from z = (x, e_c) at one time. Let an event be lost at
least w after the delivery, and ‖e_c‖_W ≤ D up to it. z is the value w before it, z' = e^{Fw} z:

    ‖Λx‖ ≤ c,  ‖e_c‖ ≤ D at z, half way and at z',  ‖e_s‖ = ‖C_r z'‖ ≤ β for r until the next event

With positive weights of sum 1, z is in the ellipsoid of the sum of these forms, which bounds
e_c = (0, I) e^{Fr} z' after r. The weights are improved step by step; all weights give a bound.
"""

import numpy as np

from noack.core.linear_systems import Matrix, Vector, exponential
from noack.theory.contraction import Stack, logarithmic_norm
from noack.theory.delivery_flow import ROUNDING, DeliveryFlow, Reach
from noack.theory.kernel_bounds import KernelBounds

_NEAR, _RATIO, _MOST_NODES = (0.0, 0.5, 0.75, 1.0), 1.1, 80
"""First nodes of r in units of δ; then the ratio from node to node."""
_LATEST = 6.0
"""Largest r in units of δ at which events are looked for."""
_SOUGHT = 0.8
"""‖e^{(H+αI)r}‖_W at the last r, if possible."""
_WORTH = 0.999
"""Share of the bound without the flow from which on nothing is gained."""
_NOTHING = 1e-3
"""Bound of ‖e_c‖ at a delivery, where it is 0, in β."""
_ROUNDS, _POWER, _LEAST_WEIGHT, _NEARLY = 40, 0.3, 1e-9, 0.97
_TAYLOR_TERMS, _CONDITION = 8, 1e-10


def errors_after_losses(
    reach: Reach,
    plain: Vector,
    size: float,
    level: float,
    spacing_s: float,
    kernel: KernelBounds,
    bend: float,
) -> Vector:
    """Bound ‖e_c‖_W while at most 0, 1, … events have been lost since the delivery.

    Args:
        reach: the flow from a delivery; it is invariant.
        plain: bounds without the flow, for 0, 1, … events.
        size: bound of ‖e_s‖_W.
        level: ‖e_s‖_W at an event, at least.
        spacing_s: the least time between events.
        kernel: of ‖e^{(H+αI)τ}‖_W.
        bend: that of e_s, see :func:`bend_of_error`.
    """
    found, since_s, flow = plain.copy(), 0.0, reach.starts.flow
    most_s = float(flow.edges_s[-1]) / 4  # e^{Fτ} is accurate until 4 times as late
    if spacing_s >= most_s or len(plain) == 1:
        return found
    r_s = _nodes_s(spacing_s, kernel, 2 * most_s)
    flows = np.array([exponential(flow.generator * time_s) for time_s in r_s.tolist()])
    for lost in range(len(plain)):
        earlier = float(found[lost - 1]) if lost else _NOTHING * size
        stage = _Stage(reach, min(since_s, most_s), earlier, r_s, flows)
        if lost:
            added = size + kernel.sups(r_s) * earlier
            largest = max(stage.largest_error(size, added), float(added[-1]), earlier)
            found[lost] = min(plain[lost], largest)
            if lost > 1 and found[lost] > _WORTH * float(added[0]):
                break  # later stages gain nothing, either
        if lost + 1 < len(plain):
            since_s += max(spacing_s, stage.next_event_s(level, bend, _LATEST * spacing_s))
    return found


def bend_of_error(reach: Reach, level: float) -> float:
    """Bound the second derivative of e_s while ‖e_s‖_W is below a level."""
    flow = reach.starts.flow
    n, F, H = flow.n, flow.generator, flow.H
    bend = reach.sup((F @ F)[n:] - np.hstack([np.zeros((n, n)), H @ H]))
    return bend + float(np.linalg.norm(H @ H, 2)) * level


def _nodes_s(spacing_s: float, kernel: KernelBounds, most_s: float) -> Vector:
    """Return times r, if possible up to one at which ‖e^{(H+αI)r}‖_W has fallen below a value."""
    found = [spacing_s * share for share in _NEAR]
    while len(found) < _MOST_NODES and kernel.sup(found[-1]) > _SOUGHT:
        found.append(found[-1] * _RATIO)
    return np.array([time_s for time_s in found if time_s <= most_s])


class _Stage:
    """What follows an event, a time w or more after the delivery, for times r since it."""

    def __init__(
        self, reach: Reach, window_s: float, earlier: float, r_s: Vector, flows: Stack
    ) -> None:
        self._flow, self._r_s, self._earlier = reach.starts.flow, r_s, earlier
        n, one = self._flow.n, np.eye(2 * self._flow.n)
        half = exponential(self._flow.generator * window_s / 2)
        rows = [one[n:] / earlier, half[n:] / earlier, (half @ half)[n:] / earlier]
        rows.append(reach.starts.shape @ one[:n] / reach.size)
        forms = np.array([row.T @ row for row in rows])
        self._forms = np.broadcast_to(forms, (len(r_s), *forms.shape))
        self._z = flows @ half @ half
        # x + e_c follows the models: e^{Hr} is the sum of both rows of e^{Fr} (I, 0).
        models = flows[:, :n, :n] + flows[:, n:, :n]
        self._e_s = self._z[:, n:] - models @ (half @ half)[n:]

    def largest_error(self, size: float, added: Vector) -> float:
        """Bound ‖e_c‖_W up to the last r, given bounds without the flow for the nodes."""
        n = self._flow.n
        events = (self._e_s.swapaxes(1, 2) @ self._e_s)[:-1, None] / size**2
        forms = np.concatenate([self._forms[:-1], events], axis=1)
        ends, weights = _largest(forms, self._z[1:, n:], float(added[-1]))
        cells = np.maximum(ends, np.append(self._earlier, ends[:-1])) + self._sags(forms, weights)
        return float(np.minimum(cells, added[:-1]).max())

    def _sags(self, forms: Stack, weights: Stack) -> Vector:
        """Bound how much e_c differs from its chord in each cell of r."""
        F, steps_s = self._flow.generator, np.diff(self._r_s)[:, None, None]
        inverse = np.linalg.inv(np.einsum("ji,jiab->jab", weights, forms))
        terms, bends = F @ F @ self._z[:-1], np.zeros(len(steps_s))
        for order in range(1, _TAYLOR_TERMS + 1):
            seen = terms[:, self._flow.n :]
            bends += np.sqrt(np.abs(np.einsum("jab,jbc,jac->j", seen, inverse, seen)))
            terms = F @ terms * (steps_s / order)
        with np.errstate(over="ignore"):
            growth = np.exp(max(logarithmic_norm(F), 0.0) * steps_s[:, 0, 0])
        bends += growth * np.sqrt(np.abs(np.einsum("jab,jbc,jac->j", terms, inverse, terms)))
        return np.asarray(steps_s[:, 0, 0] ** 2 / 8 * bends * ROUNDING)

    def next_event_s(self, level: float, bend: float, most_s: float) -> float:
        """Return a time before which ‖e_s‖_W does not reach a level."""
        near = self._r_s <= most_s
        ends, _ = _largest(self._forms[near], self._e_s[near], 0.9 * level, all_of_them=True)
        sags = np.diff(self._r_s[near]) ** 2 / 8 * bend
        reached = np.maximum(ends[1:], ends[:-1]) + sags >= level
        return float(self._r_s[np.append(reached, True).argmax()])


def error_after(flow: DeliveryFlow, time_s: float) -> Matrix:
    """Return C_r: e_s a time after an event is C_r z."""
    found = np.asarray(exponential(flow.generator * time_s)[flow.n :])
    found[:, flow.n :] -= exponential(flow.H * time_s)
    return found


def _largest(
    forms: Stack, Y: Stack, enough: float, *, all_of_them: bool = False
) -> tuple[Vector, Stack]:
    """Bound ‖Y z‖ for all z with forms of at most 1, (j,), by weights, (j, i).

    None below ``enough`` is improved, and only the largest ones unless all of them are wanted.
    """
    found, weights = np.full(len(forms), np.inf), np.full(forms.shape[:2], 1 / forms.shape[1])
    active, best = np.arange(len(forms)), weights.copy()
    for _ in range(_ROUNDS):
        some = forms[active]
        Z = np.linalg.solve(
            np.einsum("ji,jiab->jab", weights[active], some), Y[active].swapaxes(1, 2)
        )
        values, vectors = np.linalg.eigh(Y[active] @ Z)
        sizes = np.sqrt(values[:, -1].clip(min=0.0)) * ROUNDING
        better = sizes < found[active]
        best[active[better]] = weights[active[better]]
        found[active] = np.minimum(found[active], sizes)
        # The forms of the z with the largest ‖Y z‖: those above the mean need more weight.
        z = (Z @ vectors[:, :, -1:])[..., 0]
        sizes = np.einsum("ja,jiab,jb->ji", z, some, z)
        weights[active] *= (sizes / sizes.max(axis=1, keepdims=True).clip(min=1e-300)) ** _POWER
        weights = weights.clip(min=_LEAST_WEIGHT)
        weights /= weights.sum(axis=1, keepdims=True)
        least = enough if all_of_them else max(enough, _NEARLY * float(found.max()))
        active = np.flatnonzero(found > least)
        if not len(active):
            break
    sums = np.linalg.eigvalsh(np.einsum("ji,jiab->jab", best, forms))
    found[~(sums[:, 0] > _CONDITION * sums[:, -1])] = np.inf
    return found, best
