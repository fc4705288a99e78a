"""The inequalities (I1) of a certificate, solved for an assumed inter-event time.

Assumptions: the trigger ‖e_s‖_W > βe^{−αt} is tested at least every h seconds, the network keeps
its guarantee about losses, and the input is held. With all signals scaled by e^{αt}:

    sup‖C e_c‖  ≤ D_C β + I_C sup‖R_E x‖ + J_C π                              (I1)
    sup‖C x‖    ≤ free_C + gain_C (q + sup‖K e_c‖)                            (the plant)
    q           ≤ Σ_{C = σKH, ½σ²KH², r(σ)W} (sup‖C x‖ + sup‖C e_c‖)          (input of age ≤ σ)
    π = sup‖p‖  ≤ sup‖K e_c‖ + q
    β̃ = sup‖e_s‖_W ≤ ḡβ + I_E sup‖R_E x‖ + I_B π                              (between two tests)

with at most N missing events: the longest burst of losses, and ⌈d/δ⌉ in flight. Each e_s, now or at
an event, is what it was at the last test, at most β, and what has entered since, through L_E and
B U. Both parts are followed on their own, each with its direction:

    D_C = sup_{r≤h} ‖C e^{Gr} W⁻¹‖ + Σ_{j<N} sup_{τ≥jδ} ‖C e^{Gτ} W⁻¹‖,       G = H + αI
    J_C = ∫₀^h ‖C e^{Gr} B U‖ dr + Σ_{j<N} min(h sup_{τ≥jδ} ‖C e^{Gτ} B U‖, I_B sup ‖C e^{Gτ} W⁻¹‖)

and I_C the same with L_E. A policy's threshold may contain more than β
(:mod:`noack.theory.bounds.trigger_bounds`); where e_s may have grown in several ways, β̃ is used in
place of β, without I_C and J_C. These inequalities are linear and hold on every [0, T]. So their
solution bounds the run if the loop gain is below 1.

**Solution.** For v ≤ F v + g with F, g ≥ 0: if some w > 0 has F w < w, the spectral radius of F is
below 1, and v ≤ x for every x with x − F x ≥ g. Both are checked with a bound of all rounding, so
nothing depends on how w and x were computed. x begins as the computed (I − F)⁻¹ g. Where x − F x
misses g by r, adding w max r/(w − F w) is enough.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.certificate_terms import CertificatePart, Constants, NetworkConditions
from noack.theory.bounds.error_growth import ErrorGrowth, first_passage_s, list_growths
from noack.theory.bounds.gains import Coefficients, Output
from noack.theory.certificates.error_rows import UNIT_ROWS, ErrorRows, Signal, SignalRows, signal_row

MOST_MISSING = 1000
"""No bounds are computed for more missing events at once: the work grows with their number."""
_EPSILON = float(np.finfo(float).eps)
"""The relative distance of two neighbouring doubles: twice the error of an operation."""


class Solution(NamedTuple):
    """The bound of v."""

    loop_gain: float
    """1 minus the smallest leading principal minor of I − F; below 1 if and only if ρ(F) < 1.
    If it is not below 1: at least the largest entry of the diagonal."""
    bound: Vector
    """(k,) upper bound of v; infinite where ρ(F) < 1 was not confirmed."""
    failing: Signal
    """The first signal with which no bound follows from those before it: that of the first
    leading principal minor not above 0. Of no use where ρ(F) < 1."""


def solve_inequalities(F: Matrix, g: Vector) -> Solution:
    """Return the smallest bound of v that follows, for F of shape (k, k) and g of (k,)."""
    size = len(g)
    # A signal that is 0 affects nothing.
    F = np.where((F.any(axis=1) | (g > 0))[:, None], F, 0.0)
    # A right side of the size of x makes w/x dimensionless.
    scales = g + F @ (g + F @ g)
    least = scales[scales > 0].min(initial=np.inf)
    right = np.where(scales > 0, scales, least if math.isfinite(least) else 1.0)
    remainder = np.eye(size) - F
    minor, x, w = _eliminate(remainder, g, right)
    loop_gain, failing = 1 - minor, Signal(0)
    is_small = loop_gain < 1
    if not is_small:  # the elimination ends too early there
        minors = np.array([np.linalg.det(remainder[:k, :k]) for k in range(1, size + 1)])
        failing = Signal(int((minors <= 0).argmax()))
        gains = np.append(np.diagonal(F), 1 - minors.min())
        loop_gain = max(float(gains.max()), 1.0) if np.isfinite(gains).all() else math.inf
    # F w < w is confirmed with all rounding, and x is raised until x − F x ≥ g.
    rounding = (size + 4) * _EPSILON
    F_x, F_w = F @ x, F @ w
    slack = w - F_w - rounding * (w + F_w)
    if not (is_small and (w > 0).all() and (slack > 0).all()):
        return Solution(loop_gain, np.full(size, np.inf), failing)
    shortfall = F_x + g - x + rounding * (F_x + g + x)
    raised = x + w * max(float((shortfall / slack).max()), 0.0) * (1 + rounding)
    return Solution(loop_gain, np.where(F.any(axis=1), raised, g), failing)


def _eliminate(matrix: Matrix, *right_sides: Vector) -> tuple[float, Vector, Vector]:
    """Return the smallest leading principal minor, and the solutions of two right sides, (k,).

    Minors after the first one not above 0 are left out; the solutions are then of no use. The
    elimination is that of Gauss without exchanges.
    """
    size = len(matrix)
    rows = np.column_stack([matrix, *right_sides])
    minor, smallest = 1.0, math.inf
    for k in range(size):
        minor *= float(rows[k, k])
        smallest = min(smallest, minor)
        if not minor > 0:
            break
        rows[k] /= rows[k, k]
        shares = rows[:, k].copy()
        shares[k] = 0.0
        rows -= np.where(shares != 0, shares, 0.0)[:, None] * rows[k]
    return smallest, rows[:, size], rows[:, size + 1]


class PartSolution(NamedTuple):
    """What the inequalities of a part give for an assumed inter-event time."""

    constants: Constants | None
    """None: there is no certificate. Without δ."""
    loop_gain: float
    """Not below 1, and perhaps infinite, where there is no certificate."""
    failing: Signal
    """The first signal without a bound, where there is no certificate: see :class:`Solution`."""
    missing_events: int
    earlier_input_error: float
    """The part of the input error that does not come from the present e_s."""


class ErrorInequalities:
    """The inequalities of one part, and their solution for assumed inter-event times.

    ``earlier_error``: sup‖p‖ while first inputs at a set-point are applied. ``drifts``: as for
    :class:`ErrorRows`.
    """

    def __init__(
        self, part: CertificatePart, conditions: NetworkConditions, earlier_error: float, *, drifts: bool
    ) -> None:
        self._error, self._plant, self._bound, self._estimation = error, plant, bound, _ = part
        self._conditions, self._drifts = conditions, drifts
        self.age_gains = error.age_gains(conditions.hold_s)
        start_error, start = plant.start_up(conditions.start_s)
        self._start_error = float(start_error)
        self._first_input_error = max(self._start_error, earlier_error)
        self._states = {
            output: Coefficients(free + start[output], gain) for output, (free, gain) in plant.states.items()
        }
        self._growths = [
            list_growths(plant, conditions.sampling_s, part_bound) for part_bound in bound.all_bounds
        ]
        begin_s = math.inf if earlier_error else conditions.start_s
        self._error_rows = ErrorRows(part, conditions, self._first_input_error, begin_s, drifts=drifts)

    @cached_method
    def solution(self, inter_event_s: float) -> PartSolution:
        """Return all constants but δ, given inter-event times of at least ``inter_event_s``."""
        conditions, events = self._conditions, self._conditions.dropouts
        if conditions.delay_s > 0:  # of arbitrarily close events, any number of updates may be in flight
            if inter_event_s == 0:
                return PartSolution(None, math.inf, Signal(0), events, math.inf)
            events += math.ceil(conditions.delay_s / inter_event_s)
        if events > MOST_MISSING:
            return PartSolution(None, math.inf, Signal(0), events, math.inf)
        solved = self._solutions(events, inter_event_s)
        smallest = np.min([solution.bound for _, solution in solved], axis=0)
        _, best = min(solved, key=lambda pair: pair[1].loop_gain)
        implied = []
        for signals, solution in solved:  # b differs from bound to bound
            bound = np.where(UNIT_ROWS[Signal.AFTER_TEST] == 1, solution.bound, smallest)
            if np.isfinite(bound).all():
                implied.append(self._implied_bounds(signals, events, best.loop_gain, bound))
        if not implied:
            return PartSolution(None, best.loop_gain, best.failing, events, math.inf)
        constants, earlier = zip(*implied, strict=True)
        smallest_fields = {
            name: min(getattr(known, name) for known in constants)
            for name in Constants._fields
            if name != "inter_event_s"
        }
        least = Constants(inter_event_s=None, **smallest_fields)
        return PartSolution(least, best.loop_gain, best.failing, events, min(earlier))

    def _solutions(self, events: int, inter_event_s: float) -> list[tuple[SignalRows, Solution]]:
        """Return the signals, and what bounds them all, for each bound of e_s."""
        solved = []
        for growths in self._growths:  # all bounds of e_s hold; of each, one growth applies
            own_growth = growths[0] if len(growths) == 1 and self._error.decays else None
            signals = self._error_rows.signals(events, inter_event_s, own_growth)
            solutions = [self._solve_for_growth(signals, growth, own_growth) for growth in growths]
            worst = max(solutions, key=lambda solution: solution.loop_gain)
            bound = np.max([solution.bound for solution in solutions], axis=0)
            solved.append((signals, worst._replace(bound=bound)))
        return solved

    def _implied_bounds(
        self, signals: SignalRows, events: int, loop_gain: float, solved: Vector
    ) -> tuple[Constants, float]:
        """Return what follows from bounds of v, (6,): the constants, and the earlier input error."""
        age_input, estimation = float(solved[Signal.AGE_INPUT]), float(solved[Signal.ESTIMATION_ERROR])
        input_error = float(signals.input_error @ solved)
        state = {C: float(free + gain * input_error) for C, (free, gain) in self._states.items()}
        received = float(signals.received @ solved) + age_input
        constants = Constants(
            rate_per_s=self._error.alpha_per_s,
            missing_events=events,
            delta=float(signals.errors[Output.WEIGHTED] @ solved + estimation) / self.unit,
            overshoot=float(signals.sensor @ solved + estimation) / self.unit,
            input_error=input_error,
            start_error=self._start_error,
            state=state[Output.STATE],
            state_weighted=state[Output.WEIGHTED],
            mismatch=state[Output.MISMATCH],
            inter_event_s=None,
            loop_gain=loop_gain,
            estimation_error=estimation,
            received_input_error=received,
            present_input_error=received,
        )
        return constants, float(signals.earlier @ solved) + age_input

    @property
    def unit(self) -> float:
        """The unit of Δ and β̃/β."""
        return self._bound.beta if self._bound.unit is None else self._bound.unit

    def _by_state(self, signals: SignalRows, shares: Mapping[str, float]) -> tuple[Vector, float]:
        """Return Σ_C share_C sup‖C x‖ as a row of the signals, (6,), and a constant."""
        free = sum(share * float(self._states[C].free) for C, share in shares.items())
        gain = sum(share * float(self._states[C].gain) for C, share in shares.items())
        return gain * signals.input_error, free

    def _solve_for_growth(
        self, signals: SignalRows, growth: ErrorGrowth, own_growth: ErrorGrowth | None
    ) -> Solution:
        """Return the loop gain, and the bounds of the signals, (6,).

        The inequality of each signal is a row of the signals and a constant.
        """
        input_error, estimation = signals.input_error, self._estimation
        row, constant = self._by_state(signals, {str(C): gain for C, gain in self.age_gains.items()})
        by_errors = sum(gain * signals.errors[output] for output, gain in self.age_gains.items())
        age_input = (row + by_errors, constant)
        row, constant = self._by_state(signals, estimation.shares)
        estimation_error = (
            row + estimation.from_input * input_error,
            estimation.fixed + constant + estimation.from_input * self._first_input_error,
        )
        mismatch = self._by_state(signals, {Output.MISMATCH: 1.0})
        row, constant = self._by_state(signals, growth.shares)
        after_test = (row + growth.estimation * UNIT_ROWS[Signal.ESTIMATION_ERROR], growth.fixed + constant)
        if own_growth is None:
            driven = self._error_rows.with_start(signal_row(0.0, 0.0, growth.driven), growth.highest)
            after_test = growth.stretch * after_test[0] + driven, growth.stretch * after_test[1]
        inequalities = {
            Signal.AGE_INPUT: age_input,
            Signal.AFTER_TEST: after_test,
            Signal.ESTIMATION_ERROR: estimation_error,
            Signal.INPUT_ERROR: (input_error, 0.0),
            Signal.MISMATCH: mismatch,
            Signal.ONE: (0.0 * input_error, 1.0),
        }
        rows = np.stack([inequalities[signal][0] for signal in Signal])
        right = np.array([inequalities[signal][1] for signal in Signal])
        return solve_inequalities(rows, right)

    def inter_event_s(self, solution: PartSolution) -> float:
        """Return the time that ‖e_s‖_W needs to the next event under the bounds of a solution."""
        constants = solution.constants
        assert constants is not None
        # The part of D_K that is the e_s of now.
        error_gain = 0.0 if self._drifts else self._error.now(Output.GAIN)
        input_error = max(solution.earlier_input_error, self._first_input_error)
        next_event_s = 0.0
        for bound in self._bound.all_bounds:
            if bound.least_event_error is not None:
                # After an event e_s is the estimation error, and x_s − x̂ differs from e_s by one, too.
                passed_s = first_passage_s(
                    self._plant,
                    level=bound.least_event_error - constants.estimation_error,
                    mismatch=constants.mismatch,
                    input_error=input_error,
                    error_gain=error_gain,
                    start=constants.estimation_error,
                )
                next_event_s = max(next_event_s, min(passed_s, bound.window_s or math.inf))
        times = self._bound.times
        next_event_s = max(min(next_event_s, times.earliest_due_s), times.shortest_s)
        if (grid_s := self._conditions.spacing_s) == 0:
            return next_event_s
        return grid_s * max(math.ceil(next_event_s / grid_s - 1e-9), 1)
