"""The flow between two deliveries: how x and e_c develop until the next one.

From one delivery to the next no update reaches the controller. So z = (x, e_c) follows a linear
system without an input, from (ξ, 0) with the state ξ at the delivery:

    x' = (A + BK + αI) x + BK e_c,    e_c' = −E x + (H − BK + αI) e_c,    z(τ) = e^{Fτ} (ξ, 0)

:class:`DeliveryFlow` has e^{Fτ} at the nodes of a grid, in coordinates in which W is the identity.
Between two nodes the bounds are those of :mod:`noack.theory.bounds.enclosure`.

**Delayed and held inputs.** If inputs are delayed or held, z begins with an e_c that is not 0, and
the age of inputs drives it; :class:`InputEffects` bounds both. What they change is added to the
bounds.

``delivery_reach.py`` bounds z for all states ξ of an ellipsoid, ``lost_events.py`` bounds e_c after
lost events.
"""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector, exponential, spectral_abscissa
from noack.theory.bounds.contraction import logarithmic_norm
from noack.theory.bounds.gains import Output, PlantGains
from noack.theory.bounds.stacked_norms import Stack, larger_ends, spectral_norms, stack_product

_FIRST_STEP = 0.005
"""First step of the grid, in time constants of the fastest mode: e^{Fτ} is then nearly straight."""
_CELLS_PER_STEP = 32
"""Number of cells after which the step is doubled, as fast modes have decayed."""
_LONGEST_STEP = 0.02
"""Limit of a step, in time constants of the fastest growing mode, which never decays."""
_MOST_GROWTH = 1e6
"""The grid ends where ‖e^{Fτ} (I, 0)‖ exceeds this, so that ``FLOW_ROUNDING`` covers its errors."""
_SETTLED = 0.03
"""The grid ends where the slowest mode of the models has decayed to this share: x_c is small then."""
_MOST_CELLS = 3000
"""Limit of the grid, for its time and memory."""
_TAYLOR_TERMS = 4
"""Terms by which a second derivative over a cell is bounded, as in ``enclosure.py``."""
FLOW_ROUNDING = 1 + 1e-5
"""Exceeds the errors of e^{Fτ}: measured, not proven (docs/theory.md, "Why the suprema are enclosed")."""


class InputEffects(NamedTuple):
    """Bounds of what held and late inputs change of the flow, from the moment an update acts."""

    age_input: float = 0.0
    """Bound of ‖q‖, p = K e_c + q."""
    first_error: float = 0.0
    """Bound of ‖e_c‖_W when an update acts."""
    acts_within_s: float = 0.0
    """The largest time from an event until its update acts."""

    @property
    def is_none(self) -> bool:
        """Whether they change nothing."""
        return self.age_input == 0 and self.first_error == 0

    def changes(self, unit_effects: tuple[Vector, Vector]) -> Vector:
        """Return by how much an output can differ, over each cell, (k,), given its unit effects."""
        by_error, by_input = unit_effects
        return self.first_error * by_error + self.age_input * by_input


NO_EFFECTS = InputEffects()
"""Inputs are neither delayed nor held."""


class DeliveryFlow:
    """e^{Fτ} (ξ, 0) at the nodes of a grid, for a known plant; W is the identity."""

    def __init__(self, plant: PlantGains) -> None:
        self.error = error = plant.error
        self.weight, self.inverse = error.weight, error.inverse_weight
        self.n = len(error.H)
        self.closed_loop = self.transformed(plant.closed_loop)
        self.BK = self.transformed(plant.B @ error.K)
        self.H = self.transformed(error.scaled_H)
        self.mismatch = E = self.closed_loop - self.H
        self.generator = np.block([[self.closed_loop, self.BK], [-E, self.H - self.BK]])
        self.start = self.weight @ plant.start
        self.model_growth = float(error.kernels[Output.WEIGHTED].sup())
        """sup ‖e^{(H+αI)τ}‖_W"""
        self.input_matrix = self.weight @ plant.input_matrix
        self.gain = error.split_K[1] @ self.inverse
        self.edges_s, self._propagators = self._grid()
        self.states = np.ascontiguousarray(self._propagators[:, :, : self.n])

    def _grid(self) -> tuple[Vector, Stack]:
        """Return the nodes τ, (k + 1,), and e^{Fτ} at them; steps become longer with τ.

        The last node is where the models have decayed, or the flow has grown too much.
        """
        fastest = max(float(np.abs(np.linalg.eigvals(self.generator)).max()), 1e-9)
        slowest, unstable = -spectral_abscissa(self.H), spectral_abscissa(self.generator)
        step_s, t_s, state = _FIRST_STEP / fastest, 0.0, np.eye(2 * self.n)
        propagator = exponential(self.generator * step_s)
        edges, states = [t_s], [state]
        for cell in range(1, _MOST_CELLS):
            t_s, state = t_s + step_s, propagator @ state
            edges.append(t_s)
            states.append(state)
            growth = np.linalg.norm(state[:, : self.n])
            if growth > _MOST_GROWTH or math.exp(-slowest * t_s) < _SETTLED:
                break
            if cell % _CELLS_PER_STEP == 0 and 2 * step_s * unstable < _LONGEST_STEP:
                step_s, propagator = 2 * step_s, propagator @ propagator
        return np.array(edges), np.array(states)

    @cached_property
    def start_response(self) -> tuple[Matrix, Vector]:
        """e^{Fτ} (x(0), 0) at the nodes, (k + 1, 2n), and bounds of its second derivative, (k,)."""
        z = self.states @ self.start[:, 0]
        terms, remainder = bend_terms(self.generator, z[:-1, :, None], np.diff(self.edges_s))
        bends = sum(np.linalg.norm(term[..., 0], axis=1) for term in terms)
        return z, np.asarray(bends + np.linalg.norm(remainder[..., 0], axis=1))

    def from_start(self, C: Matrix, error_bound: float, first_cell: int = 0) -> float:
        """Bound ‖C z‖ from a cell after the start on, until the first delivery, if ‖e_c‖_W ≤ D.

        z is at most as large as that of x(0), and small enough for D at all earlier times: it is
        that of x(0) times at most ``shares``. ``error_bound`` is D.
        """
        z, bends = self.start_response
        errors = np.maximum.accumulate(np.linalg.norm(z[:-1, self.n :], axis=1))
        shares = error_bound / np.maximum(errors, error_bound)
        at_nodes = np.linalg.norm(z @ C.T, axis=1)
        sags = np.diff(self.edges_s) ** 2 / 8 * bends * float(np.linalg.norm(C, 2))
        cells = shares * (larger_ends(at_nodes) + sags)
        return float(cells[first_cell:].max()) * FLOW_ROUNDING

    def first_event(self, level: float) -> int:
        """Return the first cell in which ‖e_s‖_W can reach a level after the start."""
        z, bends = self.start_response
        errors = np.linalg.norm(z[:, self.n :], axis=1)
        highest = larger_ends(errors) + np.diff(self.edges_s) ** 2 / 8 * bends
        return int(np.argmax(np.append(highest[:-1] * FLOW_ROUNDING >= level, True)))

    def cell_at(self, time_s: float) -> int:
        """Return the cell that contains a time."""
        return max(int(self.edges_s[1:-1].searchsorted(time_s)), 0)

    @cached_property
    def _unit_responses(self) -> tuple[Stack, Stack, Vector]:
        """e^{Fτ} (0, I) and e^{Fτ} (BU, −BU) at the nodes, and step²/8 · ‖F‖² e^{‖F‖ step}."""
        by_input = self._propagators @ np.vstack([self.input_matrix, -self.input_matrix])
        exponents = np.diff(self.edges_s) * float(np.linalg.norm(self.generator, 2))
        return self._propagators[:, :, self.n :], by_input, exponents**2 / 8 * np.exp(exponents)

    def unit_effects(self, C: Matrix) -> tuple[Vector, Vector]:
        """Bound sup ‖C e^{Fτ} (0, I)‖ over each cell, and ∫₀^τ ‖C e^{Fs} (BU, −BU)‖ ds, (k,)."""
        by_error, by_input, sag_factors = self._unit_responses
        norm, sups = float(np.linalg.norm(C, 2)), []
        for responses in (by_error, by_input):
            at_nodes = spectral_norms(C @ responses)
            sags = sag_factors * norm * np.linalg.norm(responses[:-1], axis=(1, 2))
            sups.append((larger_ends(at_nodes) + sags) * FLOW_ROUNDING)
        return sups[0], np.cumsum(sups[1] * np.diff(self.edges_s))

    @cached_property
    def error_effects(self) -> tuple[Vector, Vector]:
        """Bound the effects on e_c: :meth:`unit_effects` for C = (0, I)."""
        return self.unit_effects(np.eye(2 * self.n)[self.n :])

    def transformed(self, matrix: Matrix) -> Matrix:
        """Return a matrix of the system in the coordinates W x."""
        return np.asarray(self.weight @ matrix @ self.inverse)


def bend_terms(
    F: Matrix, states: Stack, steps_s: Vector, count: int = _TAYLOR_TERMS
) -> tuple[list[Stack], Stack]:
    """Return Taylor's terms of F² e^{Fτ} Y over cells, and one that bounds the remainder, (k, n, r) each.

    ``states``: Y, e^{Fτ} at the left nodes of the cells.
    """
    terms = [stack_product(F @ F, states)]
    for order in range(1, count + 1):
        terms.append(stack_product(F, terms[-1]) * (steps_s / order)[:, None, None])
    with np.errstate(over="ignore"):
        growth = np.exp(max(float(logarithmic_norm(F)), 0.0) * steps_s)
    return terms[:-1], growth[:, None, None] * terms[-1]


def bend_rows(flow: DeliveryFlow) -> Matrix:
    """Return the matrix of the part of e_s'' that follows from z."""
    n, F, H = flow.n, flow.generator, flow.H
    return np.asarray((F @ F)[n:] - np.hstack([np.zeros((n, n)), H @ H]))


def error_since_event(flow: DeliveryFlow, time_s: float) -> Matrix:
    """Return C_r: e_s a time after an event is C_r z."""
    rows = np.asarray(exponential(flow.generator * time_s)[flow.n :])
    rows[:, flow.n :] -= exponential(flow.H * time_s)
    return rows
