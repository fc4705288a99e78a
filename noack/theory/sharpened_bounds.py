"""Certified constants, sharpened by the flow between two deliveries, for the paper's conditions.

Given ‖e_c‖_W ≤ D at all times, an ellipsoid ‖Λx‖ ≤ 1 is found that x never leaves
(:mod:`noack.theory.delivery_flow`). It bounds x and E x, and the flow from it bounds K e_c. After
an event e_s begins at 0; after r it is C_r z(t_k), C_r = (0, I) e^{Fr} − e^{(H+αI)r} (0, I), as
long as no update is received. At the event z(t_k) is (ξ, 0), or up to it ‖e_c‖_W ≤ D', since one
event less is missing than may be. So the next event comes later than certified without the flow,
and D is smaller with this longer time. Every step uses bounds that hold already.

Λ comes from a Lyapunov equation with three parameters. They are chosen by samples; what they give
is checked with all enclosures.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.theory.delivery_flow import ROUNDING, DeliveryFlow, Reach
from noack.theory.error_growth import COARSE_CELLS
from noack.theory.gains import PlantGains

_MARGINS = (1.0, 1.02, 1.05, 1.08, 1.12, 1.2, 1.35)
"""Factors of the ellipsoid's computed size that are tried."""
_STARTS = [(-1.5, -2.0, -7.0), (0.0, -7.0, -7.0), (-1.5, 0.0, -1.0), (-1.5, -7.0, -1.0)]
"""Parameters of the ellipsoid that are tried first."""
_REACH, _EVALUATIONS = 1.5, 50
_COARSE, _FINE = np.exp(np.arange(-10.0, 17.0, 2.0)), np.exp(np.linspace(-1.5, 1.5, 9))
"""Multipliers μ: all of them, and around the best one."""
_NODES, _CRITICAL = 32, 6
_SETTLED = 0.01
_ILL_CONDITIONED = 1e8
_LEAST_SHARE = 1e-6


class SharpenedBounds(NamedTuple):
    """Bounds of all times; see :class:`noack.theory.certificate.Constants`."""

    input_error: float
    state: float
    state_weighted: float
    mismatch: float
    inter_event_s: float | None


@dataclass(frozen=True)
class InvariantEllipsoids:
    """The ellipsoids ‖Λx‖ ≤ 1 that x does not leave under bounds of e_c."""

    plant: PlantGains
    largest: float
    """The largest D, for which Λ is chosen."""

    def sharpened(
        self, known: SharpenedBounds, limit: float, lost: float, level: float | None
    ) -> SharpenedBounds:
        """Return the smaller of the known bounds and those from the flow.

        Args:
            known: bounds that hold.
            limit: D, a bound of ‖e_c‖_W.
            lost: the same up to a lost event, at which one event less is missing than may be.
            level: ‖e_s‖_W at an event, at least; None if it may be arbitrarily small.
        """
        reach = self.within(limit)
        if reach is None:
            return known
        flow, inverse = self.flow, np.linalg.inv(reach.shape)
        gain = self.plant.error.split_K[1] @ flow.inverse

        def of_state(C: Matrix) -> float:
            return float(np.linalg.norm(C @ inverse, 2)) * ROUNDING

        found = SharpenedBounds(
            min(known.input_error, reach.sup(np.hstack([np.zeros_like(gain), gain]))),
            min(known.state, of_state(flow.inverse)),
            min(known.state_weighted, of_state(np.eye(flow.n))),
            min(known.mismatch, of_state(flow.mismatch)),
            known.inter_event_s,
        )
        if level is None or known.inter_event_s is None:
            return found
        at_events = Reach(flow, reach.shape, max(min(lost, limit), _LEAST_SHARE * limit))
        return found._replace(inter_event_s=self._next_event_s(at_events, found, level))

    def within(self, limit: float) -> Reach | None:
        """Return the flow from an ellipsoid for these bounds; None if none is found."""
        size = self._size(self._chosen, limit)
        if not math.isfinite(size) or np.linalg.cond(self._chosen) > _ILL_CONDITIONED:
            return None
        shape = self._chosen / size
        reaches = (Reach(self.flow, shape / margin, limit) for margin in _MARGINS)
        return next((one for one in reaches if one.is_invariant()), None)

    @cached_property
    def flow(self) -> DeliveryFlow:
        """The flow between two deliveries."""
        return DeliveryFlow(self.plant)

    @cached_property
    def _chosen(self) -> Matrix:
        """Λ for a small bound of ‖x‖."""
        from scipy.optimize import minimize

        def merit(parameters: Vector) -> float:
            try:
                shape = self._shape(parameters)
                state = float(np.linalg.norm(self.flow.inverse @ np.linalg.inv(shape), 2))
                return state * self._size(shape, self.largest)
            except np.linalg.LinAlgError:
                return math.inf

        first = min(_STARTS, key=lambda start: merit(np.array(start)))
        simplex = np.vstack([first, np.array(first) + _REACH * np.eye(len(first))])
        found = minimize(
            merit, simplex[0], method="Nelder-Mead",
            options={"maxfev": _EVALUATIONS, "initial_simplex": simplex},
        )  # fmt: skip
        return self._shape(np.asarray(found.x))

    def _shape(self, parameters: Vector) -> Matrix:
        """Return Λ with (ΛᵀΛ)⁻¹ = X, (M + νI)X + X(M + νI)ᵀ = −Q; its scale is arbitrary.

        M = A + BK, and Q is BK Kᵀ Bᵀ with shares of the identity and of x(0) x(0)ᵀ.
        """
        from scipy.linalg import solve_continuous_lyapunov

        flow, n = self.flow, self.flow.n
        logit, all_x, x0 = parameters.clip(-15.0, 15.0)
        share = 0.1 + 0.85 / (1 + math.exp(-logit))
        rate = share * -spectral_abscissa(flow.closed_loop)
        Q = math.exp(all_x) / n * np.eye(n)
        for weight, column in ((1.0, flow.BK), (math.exp(x0), flow.start)):
            Q += weight * column @ column.T / max(float((column**2).sum()), 1e-300)
        if not np.isfinite(Q).all():
            raise np.linalg.LinAlgError("the squares of the entries overflow")
        X = solve_continuous_lyapunov(flow.closed_loop + rate * np.eye(n), -Q)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(0.5 * (X + X.T))))

    def _size(self, shape: Matrix, limit: float) -> float:
        """Return about the smallest c for which ‖Λx‖ ≤ c is invariant and contains x(0).

        At a node it does not exceed c if c² ≥ μ/(1 − λ) for some μ, λ the largest eigenvalue of
        ‖ΛΦξ‖² − μ‖Nξ‖²/D² on ‖Λξ‖ = 1, (Φ, N) ξ = e^{Fτ} (ξ, 0).
        """
        flow, n, inverse = self.flow, self.flow.n, np.linalg.inv(shape)
        count = len(flow.edges_s) - 1
        times_s = np.geomspace(float(flow.edges_s[1]), float(flow.edges_s[-1]), _NODES)
        late = flow.edges_s.searchsorted(times_s)
        even = np.linspace(1, count, _NODES // 2).astype(int)
        nodes = flow.states[np.unique([*late.clip(1, count), *even])]
        grams = [
            Y.transpose(0, 2, 1) @ Y
            for Y in (shape @ nodes[:, :n] @ inverse, nodes[:, n:] @ inverse / limit)
        ]
        grows = np.linalg.eigvalsh(grams[0])[:, -1] >= 1
        sizes = np.zeros(1)
        if grows.any():
            image, error = (gram[grows] for gram in grams)
            sizes, best = _sizes(image, error, np.tile(_COARSE, (len(image), 1)))
            last = np.argsort(sizes)[-_CRITICAL:]
            sizes, _ = _sizes(image[last], error[last], best[last, None] * _FINE)
        start = float(np.linalg.norm(shape @ flow.start, 2)) * ROUNDING
        return max(math.sqrt(sizes.max()), start)

    def _next_event_s(self, reach: Reach, known: SharpenedBounds, level: float) -> float:
        """Return a time before which ‖e_s‖_W cannot reach ``level`` after an event.

        It is at least the known one. From each time at which the flow bounds ‖e_s‖_W, it grows as
        between two tests.
        """
        plant, found_s = self.plant, known.inter_event_s or 0.0
        speed = known.mismatch + known.input_error * float(
            np.linalg.norm(plant.error.weight @ plant.input_matrix, 2)
        )
        if not speed > 0 or not math.isfinite(found_s):
            return found_s
        while True:
            size = reach.sup(_error_after(reach.flow, found_s))
            step_s = (level - size) / speed
            while step_s > _SETTLED * found_s:
                growth = plant.growth(step_s, COARSE_CELLS)
                grown = plant.error.stretch(step_s) * size
                grown += growth.mismatch.integral_on_grid() * known.mismatch
                grown += growth.input_error.integral_on_grid() * known.input_error
                if grown < level:
                    break
                step_s *= 0.8
            else:
                return found_s
            found_s += step_s


def _sizes(image: Matrix, error: Matrix, multipliers: Matrix) -> tuple[Vector, Vector]:
    """Return the smallest c² over the multipliers, (k, j), and its multiplier, for k nodes."""
    forms = image[:, None] - multipliers[..., None, None] * error[:, None]
    left = np.linalg.eigvalsh(forms)[..., -1]
    with np.errstate(divide="ignore"):
        found = np.where(left < 1, multipliers / (1 - left.clip(min=0.0)), np.inf)
    best = found.argmin(axis=1)
    rows = np.arange(len(found))
    return found[rows, best], multipliers[rows, best]


def _error_after(flow: DeliveryFlow, time_s: float) -> Matrix:
    """Return C_r: e_s a time after an event is C_r z."""
    from scipy.linalg import expm

    found = np.asarray(expm(flow.generator * time_s)[flow.n :])
    found[:, flow.n :] -= expm(flow.H * time_s)
    return found
