"""A time-triggered loop with random losses: its growth in mean square.

From one transmission to the next the state z = (x, x_c, u, w) of the loop becomes M₀z if the update
is delivered and M₁z if it is lost. The outcomes are a chain of states; P_ij is the probability that
state j follows state i and the update is delivered, L_ij the same for a loss. The second moments
X_j = E[z zᵀ; state j] therefore follow

    X_j ← Σ_i (L_ij M₁ X_i M₁ᵀ + P_ij M₀ X_i M₀ᵀ),

and E‖z‖² grows exactly like the powers of this operator's spectral radius.

The spectral radius is computed in double precision, in coordinates of the maps' common range. That
it is below a bound γ is tested: for some X_j > 0 the operator's image is below γ X_j, with all
rounding enclosed, in coordinates of all states (:meth:`PeriodMaps.is_below`). noack-check does not verify it,
so the growth is called computed.
"""

from collections.abc import Sequence
from functools import reduce
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from netem.guarantee.loss_guarantee import LossGuarantee
from netem.impairments.loss_prediction import LossProcess, OutcomeChain
from netem.impairments.markov_chain import NotPredictableError
from noack.core.linear_systems import Matrix, Stack, Vector, balancing_exponents
from noack.proof.period_times import NEVER, LoopTimes
from noack.scenario.arrival_ties import with_later_updates
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.time_triggered.exact_matrices import IntervalMatrix, exactly, inverse
from noack.theory.time_triggered.graph import Graph
from noack.theory.time_triggered.scenario_times import intervals, loop_times
from noack.theory.time_triggered.time_triggered_loop import TimeTriggeredLoop

if TYPE_CHECKING:
    from scipy.sparse import csc_array  # slow to import

_MOST_ENTRIES = 16_000
"""Largest size of the operator's matrix, which is sparse: few states follow a state."""
_MOST_SLOTS = 100
"""Transmissions after which the times of a loop must repeat: each has maps of its own."""
_MOST_DENSE = 500
"""Size up to which all eigenvalues are computed."""
_ABOVE = (1e-7, 1e-6, 1e-5, 1e-4)
"""The bound of the spectral radius is the first of these shares above it that passes the test."""
_SMALLEST = 1e-30
"""Smallest bound of a spectral radius that is tried."""
_OTHERS = 1e-3
"""X_j in the coordinates beyond the common range, relative to the square of the largest map."""


class MeanSquareGrowth(NamedTuple):
    """The growth of a loop under random losses that nothing limits."""

    per_period: float
    """Upper bound of the growth of √(E‖z‖²) per period, exact up to 1e-6."""
    has_ties: bool = False
    """Whether updates arrive at ticks of the controller; each then acts at the next one."""

    @property
    def text(self) -> str:
        """The conclusion as a sentence."""
        verdict = "stable" if self.per_period < 1 else "not stable"
        return (
            f"√E‖z‖² of the loop's state z changes by the factor {self.per_period:.6g} per period: "
            f"{verdict} in mean square (computed{', each update at the later of its ticks' * self.has_ties})"
        )


def growth_without_guarantee(resolved: Scenario, losses: LossProcess) -> MeanSquareGrowth:
    """Return the growth of a scenario's loop under random losses that nothing limits.

    Raises:
        NotPredictableError: loop and losses have too many states, or the sensor is not
            time-triggered.
    """
    resolved, tie = with_later_updates(resolved)
    between = intervals(resolved)
    if len(between) > 1:
        raise NotPredictableError("the times between updates are not known")
    loop, times = loop_of(resolved), loop_times(resolved, between[0])
    if times.timeout < NEVER:
        raise NotPredictableError("controller.update_timeout_s: the input depends on the update's age")
    require_few_slots(times)
    exact = TimeTriggeredLoop(loop.A, loop.B, loop.K, loop.H, times)
    try:
        maps = [(exact.period(slot, True), exact.period(slot, False)) for slot in range(times.slots)]
    except OverflowError:
        raise NotPredictableError("the loop grows beyond 1e308 within a period") from None
    return MeanSquareGrowth(mean_square_growth(maps, losses.outcomes(LossGuarantee())), bool(tie))


def require_few_slots(times: LoopTimes) -> None:
    """Raise NotPredictableError if the loop's times repeat only after many periods."""
    if times.slots > _MOST_SLOTS:
        raise NotPredictableError("the times of the loop repeat only after many periods")


def mean_square_growth(
    maps: Sequence[tuple[IntervalMatrix, IntervalMatrix]], outcomes: OutcomeChain
) -> float:
    """Return the growth of √(E‖z‖²) per period, as an upper bound that is exact up to 1e-6.

    Args:
        maps: M₀ (delivered) and M₁ (lost), (N, N) each, for every slot: period k uses the pair
            k modulo their number.
        outcomes: outcomes of the updates.

    Raises:
        NotPredictableError: there are too many states.
    """
    return float(PeriodMaps.of(maps).radius_bound(outcomes) ** (0.5 / len(maps)))


class PeriodMaps(NamedTuple):
    """M₀ and M₁ for every slot, in coordinates in which no direction grows much more than others."""

    reduced: list[tuple[Matrix, Matrix]]
    """Of the first coordinates, which are those of the maps' common range, to rounding."""
    enclosed: Sequence[tuple[IntervalMatrix, ...]]
    """Of all coordinates."""

    @classmethod
    def of(cls, maps: Sequence[tuple[IntervalMatrix, IntervalMatrix]]) -> "PeriodMaps":
        """Find the coordinates.

        Raises:
            NotPredictableError: an entry is infinite, or the coordinates are not accurate.
        """
        stack = np.array([[part.middle for part in slot] for slot in maps])
        size = stack.shape[-1]
        if not np.isfinite(stack).all():
            raise NotPredictableError("the loop grows beyond 1e308 within a period")
        exponents = balancing_exponents(np.abs(stack).max(axis=(0, 1)))
        shifts = exponents[:, None] - exponents
        stack = np.ldexp(stack, shifts)
        # The common range of all maps, and balanced coordinates of it.
        U, singular, _ = np.linalg.svd(stack.transpose(2, 0, 1, 3).reshape(size, -1))
        rank = max(int((singular > 10 * size * np.finfo(float).eps * singular[0]).sum()), 1)
        range_maps = U[:, :rank].T @ stack @ U[:, :rank]
        every = range_maps.reshape(-1, rank, rank)
        nodes = np.zeros(len(every), np.int64)
        (T,) = Graph(nodes, nodes, nodes + 1).balancing(every)
        range_maps = T @ range_maps @ np.linalg.inv(T)
        # The same coordinates for the enclosed maps, and orthogonal ones beyond the range.
        coordinates = U.T.copy()
        coordinates[:rank] = T @ coordinates[:rank]
        if (inverse_coordinates := inverse(coordinates)) is None:
            raise NotPredictableError("the loop's states have too different sizes")
        enclosed = [
            (
                exactly(coordinates) @ delivered.scaled(shifts) @ inverse_coordinates,
                exactly(coordinates) @ lost.scaled(shifts) @ inverse_coordinates,
            )
            for delivered, lost in maps
        ]
        return cls([(delivered, lost) for delivered, lost in range_maps], enclosed)

    def radius_bound(self, outcomes: OutcomeChain) -> float:
        """Return an upper bound of the spectral radius of the operator, mostly exact up to 2e-7.

        Raises:
            NotPredictableError: it cannot be computed.
        """
        from scipy.sparse import linalg  # slow to import

        steps = (second_moments(delivered, lost, outcomes) for delivered, lost in self.reduced)
        operator = reduce(lambda before, step: step @ before, steps)
        if not np.isfinite(operator.data).all():
            raise NotPredictableError("the loop's second moments exceed 1e308 within a few periods")
        if operator.shape[0] <= _MOST_DENSE:
            radius = float(np.abs(np.linalg.eigvals(operator.toarray())).max())
        else:
            start = np.ones(operator.shape[0])
            try:
                radius = float(np.abs(linalg.eigs(operator, k=1, v0=start)[0]).max())
            except linalg.ArpackNoConvergence:
                raise NotPredictableError("the second moments' growth was not found") from None
        for above in _ABOVE:
            bound = max(radius, _SMALLEST) * (1 + above)
            size = len(self.reduced[0][0])
            identity = triangles(np.tile(np.eye(size), (len(outcomes.lost), 1, 1)))
            try:
                solution = from_triangles(solve_resolvent(operator, bound, identity), size)
            except RuntimeError:  # singular by rounding
                continue
            if self.is_below(bound, solution, outcomes):
                return bound
        raise NotPredictableError("the second moments could not be bounded numerically")

    def is_below(self, bound: float, forms: Stack, outcomes: OutcomeChain) -> bool:
        """Return whether X_j > 0 with operator(X) < bound X show that a bound is one.

        Args:
            bound: γ
            forms: X_j in the first coordinates, (modes, rank, rank); in the others X_j is a small
                multiple of the identity.
            outcomes: outcomes of the updates.
        """
        modes, rank = len(forms), forms.shape[-1]
        size = self.enclosed[0][0].middle.shape[0]
        largest = max(float(part.magnitude.max()) for slot in self.enclosed for part in slot)
        X = np.tile(_OTHERS / (1 + (size * largest) ** 2) * np.eye(size), (modes, 1, 1))
        X[:, :rank, :rank] = forms
        transitions = exactly(np.vstack([outcomes.delivered, outcomes.lost]).T)
        image = exactly(X)
        for slot in self.enclosed:
            parts = [M @ image @ M.transposed for M in slot]
            flat = [np.concatenate(part).reshape(2 * modes, -1) for part in zip(*parts, strict=True)]
            mixed = transitions @ IntervalMatrix(*flat)
            image = IntervalMatrix(*(part.reshape(X.shape) for part in mixed))
        scaled = exactly(bound * np.eye(size)) @ exactly(X)
        return _is_positive(exactly(X)) and _is_positive(scaled - image)


def _is_positive(forms: IntervalMatrix) -> bool:
    """Return whether symmetric matrices are positive definite in interval arithmetic, (k, N, N).

    R, the inverse of a computed triangular factor, makes each nearly the identity; R X Rᵀ differs
    from it by less than 1 in the norm of the largest row sum.
    """
    try:
        R = np.linalg.inv(np.linalg.cholesky((forms.middle + forms.middle.swapaxes(1, 2)) / 2))
    except np.linalg.LinAlgError:
        return False
    transformed = exactly(R) @ forms @ exactly(R.swapaxes(1, 2).copy())
    defect = (exactly(np.eye(R.shape[-1])) - transformed).magnitude.sum(axis=-1)
    return bool(defect.max() * (1 + 1e-12) < 1)


def second_moments(delivered: Matrix, lost: Matrix, outcomes: OutcomeChain) -> "csc_array[np.float64]":
    """Return the operator of one period on the stacked upper triangles of X_j.

    Raises:
        NotPredictableError: there are too many states.
    """
    from scipy import sparse  # slow to import

    size = len(delivered)
    if len(outcomes.lost) * size * (size + 1) // 2 > _MOST_ENTRIES:
        raise NotPredictableError("loop and losses together have too many states to compute with")
    losing = sparse.kron(sparse.csr_array(outcomes.lost.T), _on_triangle(lost))
    delivering = sparse.kron(sparse.csr_array(outcomes.delivered.T), _on_triangle(delivered))
    return (losing + delivering).tocsc()


def _on_triangle(matrix: Matrix) -> Matrix:
    """Return the map of the upper triangle of X to that of M X Mᵀ."""
    i, j = np.triu_indices(len(matrix))
    straight = matrix[np.ix_(i, i)] * matrix[np.ix_(j, j)]
    return np.asarray(straight + matrix[np.ix_(i, j)] * matrix[np.ix_(j, i)] * (i != j))


def from_triangles(entries: Vector, size: int) -> Stack:
    """Return the symmetric matrices with these upper triangles, (number, size, size)."""
    i, j = np.triu_indices(size)
    stack = np.zeros((len(entries) // len(i), size, size))
    stack[:, i, j] = stack[:, j, i] = entries.reshape(-1, len(i))
    return stack


def triangles(stack: Stack) -> Vector:
    """Return the upper triangles of symmetric matrices, one after the other."""
    i, j = np.triu_indices(stack.shape[-1])
    return stack[..., i, j].ravel()


def solve_resolvent(operator: "csc_array[np.float64]", value: float, entries: Vector) -> Vector:
    """Return the solution X of value · X − operator(X) = the entries."""
    from scipy.sparse import eye_array, linalg  # slow to import

    resolvent = (value * eye_array(operator.shape[0]) - operator).tocsc()
    return np.asarray(linalg.splu(resolvent).solve(entries), dtype=np.float64)
