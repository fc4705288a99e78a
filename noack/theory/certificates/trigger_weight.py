"""Chooses the weight W of the trigger's norm for the tightest certificate under given conditions.

If P = WᵀW and (H+αI)ᵀP + P(H+αI) ⪯ 0, ‖·‖_W contracts along the models. Then Δ ≤ M on a network
without delay. Among these factors W, the search first lowers the loop gain until there is a
certificate, and then X/δ³: P solves the Lyapunov equation for some Q ⪰ 0, and Q is varied. W is
scaled to |det W| = 1, so that ‖W e‖ ≤ β encloses the same volume as ‖e‖ ≤ β.

The search uses kernels that are sampled, not enclosed. Whatever W it finds is certified afterwards.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.scenario.resolution import LoopMatrices
from noack.theory.bounds.certificate_terms import NetworkConditions, NoCertificateError, TriggerBound
from noack.theory.bounds.enclosure import KernelBounds, NotDecayingError, response
from noack.theory.bounds.gains import Coefficients, ErrorGains, Output, PlantGains
from noack.theory.bounds.stacked_norms import Stack, larger_ends, spectral_norms, stack_product
from noack.theory.certificates.solution import solve

_ROUNDS_PER_SCALE, _ROUNDS, _ROUNDS_PER_ENTRY = 15, 40, 12
"""Evaluations of the merit: for each scale of a state; for the entries of L, and for each of them."""
_MOST_FREE = 7
"""Largest number of states for which all entries of L are varied; beyond it, only the diagonal is."""
_NODES = 256
"""Nodes at which responses are sampled."""
_VOID = 1e3
"""Merit of a weight without certificate, on top of its loop gain."""


def choose_weight(
    loop: LoopMatrices,
    beta: float,
    alpha_per_s: float,
    conditions: NetworkConditions,
    progress: Callable[[float], None] = lambda share: None,
) -> Matrix:
    """Return W, upper triangular, (n, n), for a loop of any weight.

    ``progress`` receives the completed share of the work.

    Raises:
        NotDecayingError: α is not below the decay rate of e^{Ht} and e^{(A+BK)t}.
    """
    from scipy.optimize import minimize  # slow to import

    n = loop.n
    for name, matrix in (("the models", loop.H), ("A + BK", loop.A + loop.B @ loop.K)):
        if spectral_abscissa(matrix) + alpha_per_s >= 0:
            raise NotDecayingError(f"α = {alpha_per_s:g} /s is not below the decay rate of {name}")
    samples, bound = _Samples(loop, alpha_per_s), TriggerBound(beta, beta)
    # Off-diagonal entries of Q are varied only for few states; for more they cost too much time.
    full = np.tril_indices(n) if n <= _MOST_FREE else np.diag_indices(n)
    scale_rounds = _ROUNDS_PER_SCALE * n
    entry_rounds = _ROUNDS + _ROUNDS_PER_ENTRY * len(full[0])
    rounds = 0

    def search(evaluations: int, start: Vector, factor: Callable[[Vector], Matrix]) -> Vector:
        def merit(entries: Vector) -> float:
            nonlocal rounds
            rounds += 1
            progress(min(rounds / (scale_rounds + entry_rounds), 1.0))
            weight = _weight(loop.H, alpha_per_s, factor(entries))
            return 2 * _VOID if weight is None else samples.merit(weight, conditions, bound)

        best = minimize(merit, start, method="Nelder-Mead", options={"maxfev": evaluations, "adaptive": True})
        return np.asarray(best.x)

    def triangular(entries: Vector) -> Matrix:
        L = np.zeros((n, n))
        L[full] = entries
        return L

    # First the scales of the states, which may have very different units.
    scales = search(scale_rounds, np.zeros(n), lambda logs: np.diag(np.exp(logs)))
    best = search(entry_rounds, np.diag(np.exp(scales))[full], triangular)
    progress(1.0)
    for L in (triangular(best), np.eye(n)):
        weight = _weight(loop.H, alpha_per_s, L)
        if weight is not None:
            return weight
    raise NotDecayingError("no Lyapunov function of the models was found")


@dataclass(frozen=True)
class _Samples:
    """The responses of a loop that no weight changes, at few nodes."""

    loop: LoopMatrices
    alpha_per_s: float

    @cached_property
    def plain(self) -> PlantGains:
        """The loop's gains without a weight."""
        loop = self.loop
        error = ErrorGains(loop.H, loop.K, np.eye(loop.n), self.alpha_per_s)
        return PlantGains(error, loop.A, loop.B, loop.x0[:, None], self.alpha_per_s)

    @cached_property
    def models(self) -> tuple[Vector, Stack]:
        """e^{(H+αI)τ}."""
        return _thinned(self.plain.error.scaled_H, np.eye(self.loop.n))

    @cached_property
    def plant(self) -> tuple[Vector, Stack]:
        """e^{(A+BK+αI)τ} (x(0), B U), side by side."""
        columns = np.concatenate([self.plain.start, self.plain.input_matrix], axis=1)
        return _thinned(self.plain.closed_loop, columns)

    def merit(self, weight: Matrix, conditions: NetworkConditions, bound: TriggerBound) -> float:
        """Return log X − 3 log δ, or without a certificate a large number and the loop gain."""
        loop = self.loop
        error = _SampledError(loop.H, loop.K, weight, self.alpha_per_s, samples=self)
        plant = _SampledPlant(error, loop.A, loop.B, loop.x0[:, None], self.alpha_per_s, samples=self)
        try:
            constants = solve(error, plant, conditions, bound)
        except NoCertificateError as void:
            return _VOID + min(void.loop_gain, _VOID)
        return math.log(constants.state) - 3 * math.log(constants.inter_event_s or math.inf)


@dataclass(frozen=True)
class _SampledError(ErrorGains):
    samples: _Samples = field(kw_only=True)

    @cached_property
    def kernels(self) -> Mapping[Output, KernelBounds]:
        nodes_s, states = self.samples.models
        return {
            output: _sampled(nodes_s, C @ states @ self.inverse_weight) for output, C in self.outputs.items()
        }


@dataclass(frozen=True)
class _SampledPlant(PlantGains):
    samples: _Samples = field(kw_only=True)

    @cached_property
    def states(self) -> Mapping[str, Coefficients]:
        coefficients = {}
        for output, C in self.outputs.items():
            nodes_s, states = self.samples.plant
            followed = stack_product(C, states)
            coefficients[output] = Coefficients(
                _sampled(nodes_s, followed[:, :, :1]).sup(), _sampled(nodes_s, followed[:, :, 1:]).integral()
            )
        return coefficients

    @cached_property
    def driven(self) -> Mapping[Output, tuple[KernelBounds, KernelBounds]]:
        nodes_s, states = self.samples.models
        by_input, mismatched = self.columns.input_error, self.columns.mismatch
        return {
            output: (_sampled(nodes_s, C @ states @ by_input), _sampled(nodes_s, C @ states @ mismatched))
            for output, C in self.error.outputs.items()
        }

    @cached_property
    def forced(self) -> Mapping[str, KernelBounds]:
        nodes_s, states = self.samples.plant
        return {
            output: _sampled(nodes_s, stack_product(C, states[:, :, 1:]))
            for output, C in self.outputs.items()
        }


def _thinned(generator: Matrix, D: Matrix) -> tuple[Vector, Stack]:
    """Return some of the nodes of a response, and e^{Gτ} D there."""
    responses = response(generator, D)
    nodes = np.unique(np.linspace(0, len(responses.edges_s) - 1, _NODES).astype(int))
    return responses.edges_s[nodes], responses.states[nodes]


def _sampled(nodes_s: Vector, values: Stack) -> KernelBounds:
    """Return the norms of a kernel from its values at nodes; beyond the last node it is 0."""
    norms = spectral_norms(values)
    areas, zero = np.diff(nodes_s) * (norms[:-1] + norms[1:]) / 2, np.zeros(())
    return KernelBounds(nodes_s, larger_ends(norms), areas, zero, zero, zero)


def _weight(H: Matrix, alpha_per_s: float, L: Matrix) -> Matrix | None:
    """Return W for Q = L Lᵀ; None if it fails the inequality by rounding."""
    from scipy.linalg import solve_continuous_lyapunov  # slow to import

    n = len(H)
    Q = L @ L.T
    Q += 1e-6 * np.trace(Q) / n * np.eye(n)
    P = solve_continuous_lyapunov((H + alpha_per_s * np.eye(n)).T, -Q)
    try:
        weight = np.linalg.cholesky(0.5 * (P + P.T)).T
    except np.linalg.LinAlgError:
        return None
    scale = float(np.exp(np.linalg.slogdet(weight)[1] / n))
    scaled = np.asarray(weight / scale)
    return scaled if ErrorGains(H, np.zeros((1, n)), scaled, alpha_per_s).contracts else None
