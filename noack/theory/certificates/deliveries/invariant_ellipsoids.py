"""An ellipsoid that x never leaves.

Given ‖e_c‖_W ≤ D at all times, an ellipsoid ‖Λx‖ ≤ 1 is found that x never leaves, by the flow
between two deliveries (``delivery_reach.py``). It bounds x and E x, and the flow from it bounds K
e_c. Λ comes from a Lyapunov equation with three parameters. They are chosen by samples; what they
give is checked with all enclosures.
"""

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector, solve_lyapunov, spectral_abscissa
from noack.theory.bounds.enclosure import response_until
from noack.theory.bounds.gains import Output, PlantGains
from noack.theory.bounds.stacked_norms import Stack
from noack.theory.certificates.deliveries.delivery_flow import (
    FLOW_ROUNDING,
    NO_EFFECTS,
    DeliveryFlow,
    InputEffects,
)
from noack.theory.certificates.deliveries.delivery_reach import DeliveryEllipsoid, Reach

_MARGINS = (1.0, 1.01, 1.02, 1.05, 1.08, 1.12, 1.2, 1.35)
_WIDE_MARGINS = (1.0, 1.15, 1.4, 1.8, 2.5, 3.5)
"""Factors of the ellipsoid's computed scale that are tried, as that is found by samples; the wide ones
with delay and hold, whose effects it leaves out."""
_FOLLOWED_SHARES = (0.1, 0.3, 1.0)
"""Shares of D up to which e_c is followed, if delay and hold change it: those that are tried."""
_FIRST_PARAMETERS = [(-1.5, -2.0, -7.0), (0.0, -7.0, -7.0), (-1.5, 0.0, -1.0), (-1.5, -7.0, -1.0)]
"""Parameters of the ellipsoid that are tried first: the logit of ν in its range, and the logarithms
of the shares of I and of x(0) x(0)ᵀ in Q."""
_DIRECTIONS = np.vstack([np.eye(3), -np.eye(3)])
"""In each round one of these parameters is changed, up or down."""
_PARAMETER_CHANGES = (1.5, 1.5, 1.5, 0.8, 0.8, 0.4, 0.4, 0.2)
"""Change of the parameter in each round, from coarse to fine."""
_COARSE, _FINE = np.exp(np.arange(-9.0, 13.0, 3.0)), np.exp(np.linspace(-2.0, 2.0, 9))
"""Multipliers μ: all of them, and around the best one."""
_NODES = 16
"""Number of nodes of the flow that are sampled evenly, and of those in geometric steps."""
_CRITICAL_NODES = 4
"""Nodes with the largest c, where μ is refined."""
_ILL_CONDITIONED = 1e8
"""Condition of Λ from which on it is not used: rounding could exceed ``FLOW_ROUNDING``."""


@dataclass(frozen=True)
class InvariantEllipsoids:
    """The ellipsoids ‖Λx‖ ≤ 1 that x does not leave under bounds of e_c."""

    plant: PlantGains
    largest_error_bound: float
    """The largest D, for which Λ is chosen."""
    age_gains: Mapping[Output, float] = field(default_factory=dict)
    """gain_C with ‖q‖ ≤ Σ gain_C sup‖C x_c‖, for which Λ is chosen; none if no input is held."""
    level: float = 0.0
    """‖e_s‖_W at an event, at least, if no input is held or late. Up to the first event x is that
    of the start, which need not be in the ellipsoid then."""

    def reach_within(
        self,
        error_bound: float,
        effects_of: Callable[[DeliveryEllipsoid, float], InputEffects] | None = None,
        start_s: float = 0.0,
    ) -> Reach | None:
        """Return the flow from an ellipsoid for these bounds; None if none is found.

        Args:
            error_bound: D.
            effects_of: returns how much delay and hold change the flow as long as ‖Λx‖ ≤ c.
            start_s: until then the input is 0.
        """
        ellipsoid = self._best_ellipsoid
        if ellipsoid is None or np.linalg.cond(ellipsoid.scaling) > _ILL_CONDITIONED:
            return None
        (scale,) = self._invariant_scales(ellipsoid.inverse[None], error_bound)
        if start_s > 0:
            drift = self.plant.A + self.plant.alpha_per_s * np.eye(self.flow.n)
            responses = response_until(drift, self.plant.start, start_s)
            scale = max(scale, float(responses.through(ellipsoid.scaling @ self.flow.weight).sup_on_grid()))
        if self._first_event_cell:  # the first delivery
            Y = np.hstack([ellipsoid.scaling, np.zeros_like(ellipsoid.scaling)])
            scale = max(scale, self.flow.from_start(Y, error_bound, self._first_event_cell))
        if not 0 < scale < math.inf:
            return None
        for margin in _MARGINS if effects_of is None else _WIDE_MARGINS:
            larger = float(scale * margin)
            effects = NO_EFFECTS if effects_of is None else effects_of(ellipsoid, larger)
            for share in (1.0,) if effects_of is None else _FOLLOWED_SHARES:
                reach = Reach(ellipsoid, larger, error_bound, effects, share, self._first_event_cell)
                if reach.is_invariant():
                    return reach
        return None

    @cached_property
    def flow(self) -> DeliveryFlow:
        """The flow between two deliveries."""
        return DeliveryFlow(self.plant)

    @cached_property
    def _first_event_cell(self) -> int:
        """The cell of the first event after the start."""
        return self.flow.first_event(self.level) if self.level else 0

    @cached_property
    def _best_ellipsoid(self) -> DeliveryEllipsoid | None:
        """Λ for a small bound of ‖x‖: a pattern search over its three parameters."""
        with np.errstate(all="ignore"):
            candidates = np.array(_FIRST_PARAMETERS)
            merits = self._merits(candidates)
            best, merit = candidates[merits.argmin()], merits.min()
            for change in _PARAMETER_CHANGES:
                candidates = best + change * _DIRECTIONS
                merits = self._merits(candidates)
                if merits.min() < merit:
                    best, merit = candidates[merits.argmin()], merits.min()
            (inverse,) = self._inverse_scalings(best[None])
        return DeliveryEllipsoid(self.flow, np.linalg.inv(inverse)) if math.isfinite(merit) else None

    def _merits(self, parameters: Matrix) -> Vector:
        """Return the bounds of ‖x‖ that some parameters give, (c,)."""
        inverses = self._inverse_scalings(parameters)
        usable = np.isfinite(inverses).all(axis=(1, 2))
        merits = np.full(len(parameters), np.inf)
        if usable.any():
            inverses = inverses[usable]
            scales = self._invariant_scales(inverses, self.largest_error_bound)
            scales = scales + self._scales_by_age_input(inverses, scales)
            merits[usable] = scales * np.linalg.norm(self.flow.inverse @ inverses, 2, axis=(1, 2))
        return merits

    def _scales_by_age_input(self, inverses: Stack, scales: Vector) -> Vector:
        """Return about the ‖Λx‖ to which q drives x, (c,), from these Λ⁻¹ and c."""
        if not any(self.age_gains.values()):
            return np.zeros(len(scales))
        scalings = np.linalg.inv(inverses)
        closed_loops = scalings @ self.flow.closed_loop @ inverses
        decay_rates = -np.linalg.eigvalsh(closed_loops + closed_loops.swapaxes(-1, -2))[:, -1] / 2
        gains = np.linalg.norm(scalings @ self.flow.input_matrix, 2, axis=(1, 2)) / decay_rates
        outputs, loop_gains = self.plant.error.outputs, np.zeros(len(scales))
        for output, gain in self.age_gains.items():
            C = outputs[output] @ self.flow.inverse @ inverses
            loop_gains = loop_gains + gains * gain * np.linalg.norm(C, 2, axis=(1, 2))
        is_stable = (decay_rates > 0) & (loop_gains < 1)
        return np.where(is_stable, loop_gains * scales / (1 - loop_gains), np.inf)

    def _inverse_scalings(self, parameters: Matrix) -> Stack:
        """Return Λ⁻¹ with Λ⁻¹Λ⁻ᵀ = X, (M + νI)X + X(M + νI)ᵀ = −Q, (c, n, n); not finite if none.

        M = A + BK, and Q is BK Kᵀ Bᵀ with shares of the identity and of x(0) x(0)ᵀ. Its scale is
        arbitrary.
        """
        inverses = np.full((len(parameters), self.flow.n, self.flow.n), np.nan)
        for index, (logit, all_x, x0) in enumerate(parameters.clip(-15.0, 15.0)):
            by_input, by_all, by_start = self._lyapunov_solutions(float(logit))
            X = by_input + math.exp(all_x) * by_all + math.exp(x0) * by_start
            with contextlib.suppress(np.linalg.LinAlgError):
                inverses[index] = np.linalg.cholesky(X)
        return inverses

    @cached_method
    def _lyapunov_solutions(self, logit: float) -> list[Matrix]:
        """Return X for each of the three parts of Q, for ν that follows from ``logit``."""
        flow, n = self.flow, self.flow.n
        share = 0.1 + 0.85 / (1 + math.exp(-logit))
        rate = share * -spectral_abscissa(flow.closed_loop)
        shifted = flow.closed_loop + rate * np.eye(n)
        solutions = []
        for columns in (flow.BK, np.eye(n), flow.start):
            Q = columns @ columns.T / max(float((columns**2).sum()), 1e-300)
            if not np.isfinite(Q).all():
                raise np.linalg.LinAlgError("the squares of the entries overflow")
            X = solve_lyapunov(shifted, -Q)
            solutions.append(np.asarray(0.5 * (X + X.T)))
        return solutions

    @cached_property
    def _nodes(self) -> Stack:
        """The flow at some nodes."""
        edges_s, states = self.flow.edges_s, self.flow.states
        count = len(edges_s) - 1
        late = edges_s.searchsorted(np.geomspace(float(edges_s[1]), float(edges_s[-1]), _NODES))
        even = np.linspace(1, count, _NODES).astype(int)
        return np.asarray(states[sorted({*late.clip(1, count), *even})])

    def _invariant_scales(self, inverses: Stack, error_bound: float) -> Vector:
        """Return about the smallest c for which ‖Λx‖ ≤ c is invariant and contains x(0), (c,).

        At a node it does not exceed c if c² ≥ μ/(1 − λ) for some μ, λ the largest eigenvalue of
        ‖ΛΦξ‖² − μ‖Nξ‖²/D² on ‖Λξ‖ = 1, (Φ, N) ξ = e^{Fτ} (ξ, 0).
        """
        n, scalings = self.flow.n, np.linalg.inv(inverses)
        state, error = (
            np.asarray(Y.swapaxes(-1, -2) @ Y)
            for Y in (
                scalings[:, None] @ self._nodes[:, :n] @ inverses[:, None],
                self._nodes[:, n:] @ inverses[:, None] / error_bound,
            )
        )
        first_state = (
            self.flow.start[:, 0]
            if not self._first_event_cell
            else self.flow.start_response[0][self._first_event_cell, :n]
        )
        largest = np.linalg.norm(scalings @ first_state, axis=1) ** 2 * FLOW_ROUNDING
        candidates, nodes = np.nonzero(np.linalg.eigvalsh(state)[..., -1] >= 1)
        if len(candidates):
            state, error = state[candidates, nodes], error[candidates, nodes]
            squares, best = _squared_scales(state, error, np.tile(_COARSE, (len(candidates), 1)))
            order = np.lexsort((-squares, candidates))  # the largest of each candidate first
            rank = np.arange(len(candidates)) - np.searchsorted(candidates[order], candidates[order])
            critical = order[rank < _CRITICAL_NODES]
            squares, _ = _squared_scales(state[critical], error[critical], best[critical, None] * _FINE)
            np.maximum.at(largest, candidates[critical], squares)
        return np.asarray(np.sqrt(largest))


def _squared_scales(state: Stack, error: Stack, multipliers: Matrix) -> tuple[Vector, Vector]:
    """Return the smallest c² over the multipliers, (k, j), and its multiplier, for k nodes.

    ``state`` and ``error`` are the forms ‖ΛΦξ‖² and ‖Nξ‖²/D² at the nodes.
    """
    forms = state[:, None] - multipliers[..., None, None] * error[:, None]
    largest_values = np.linalg.eigvalsh(forms)[..., -1]
    squares = np.where(largest_values < 1, multipliers / (1 - largest_values.clip(min=0.0)), np.inf)
    best = squares.argmin(axis=1)
    rows = np.arange(len(squares))
    return squares[rows, best], multipliers[rows, best]
