"""Mean squares at every fixed time without a limit on the losses, by a stochastic Lyapunov function.

All signals are scaled by e^{αt}. Let q be what the lost events since the last delivered one have
left in x_s, by (I1): had every delivered update arrived at once, e_c would be ê_c = q + e_s. With
v = p − K ê_c, between events

    x' = (A+BK+αI) x + B (K ê_c + v),   q' = (H+αI) q,   e_s' = (H+αI) e_s − E x − B (K ê_c + v)

At an event e_s becomes 0, and q becomes q + e_s if it is lost, with a probability of at most p̄
whatever happened before, and 0 else. v has three parts: v_f of the oldest update in flight, v_h of
the input's age σ, ‖v_h‖ ≤ σ‖K H (x + ê_c)‖, and w. Let y = (q, e_s) and V = xᵀX x + yᵀP y. If

    P ⪰ p̄ (I I)ᵀ P_qq (I I) + ζ_f (I I)ᵀ D (I I)         no event increases the mean of V
    V' + 2λV ≤ μ‖e_s‖_W² + ζ‖w‖² + ζ_f‖v_f‖² + ζ_h (‖v_h‖² − σ²‖K H (x + q + e_s)‖²)

for all x, y, w, v_f and v_h, then the mean of V is at most max(V(0), (μ a² + ζ ω²)/2λ) at every
fixed time, where a² and ω² bound the mean squares of ‖e_s‖_W and of w. An update is in flight for d
at most. D = ∫₀ᵈ e^{2λτ}‖K e^{(H+αI)τ}·‖² dτ bounds what it adds to V meanwhile, and is counted when it
is sent. (V has no product of x and y: an event changes y and leaves x, so the first inequality would
not hold with one.)

These are linear matrix inequalities. :func:`quadratic_functions` looks for those with the smallest
bounds (``matrix_inequalities.py``). Without delay and age they can be met for all p̄ < 1
(docs/derivations.md, "Without a limit on the losses").
"""

from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Vector, exponential, spectral_abscissa
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.bounds.gains import ErrorGains, Output, PlantGains
from noack.theory.random_losses.matrix_inequalities import Blocks, MatrixInequalities, is_positive
from noack.theory.random_losses.mean_square_growth import from_triangles, triangles

_OF_STATE, _OF_ERROR = (0.1, 0.35), (0.35, 0.75)
"""λ for small bounds of ‖x‖ and of ‖ê_c‖, as shares of the decay rate that is left at α."""
_LARGEST = 1e4
"""Bound of the traces of X and P where ‖e_s‖_W ≤ 1 and V ≤ 1; without one they could be infinite."""
_INFLATED = 1 + 1e-9
"""Exceeds the rounding of an exponential or a norm, as estimated."""
_MOST_STATES = 8
"""With 7 the four searches took up to 12 s of CPU on a busy machine, with 12 about a minute."""
_LEFT = 0.01
"""Share of the decay of x that the input's age leaves where the search begins."""


class KnownRms(NamedTuple):
    """Root mean squares that hold already, scaled by e^{αt}."""

    sensor_error: float
    """a, of ‖e_s‖_W at every fixed time."""
    other: float
    """ω, of w from the first applied input on."""
    aged: float
    """Of v_h, if it is counted as a part of w."""
    start: float
    """Of w before the first applied input."""


class QuadraticFunction(NamedTuple):
    """V, of W x, W q and W e_s."""

    state: Matrix
    """X, (n, n)."""
    errors: Matrix
    """P, (2n, 2n), with P_ss + ν I in the place of P_ss: then it is positive definite, too."""
    added: float
    """ν."""
    rate_per_s: float
    """λ."""
    of_sensor_error: float
    """μ."""
    of_inputs: Vector
    """ζ, ζ_f and ζ_h; 0 for what there is not, (3,)."""
    loop: "LossyFlow"

    def level(self, known: KnownRms) -> float:
        """Bound of the mean of xᵀXx + yᵀPy, at every fixed time."""
        loop, of_other = self.loop, self.of_inputs[0]
        entering = self.of_sensor_error * known.sensor_error**2
        entering += of_other * loop.bound_other_inputs(known) ** 2
        first = loop.start @ self.state @ loop.start
        begun = of_other * known.start**2 * loop.start_s
        added = self.added * known.sensor_error**2
        return float(max(first, entering / (2 * self.rate_per_s)) + begun + added)

    def bound_state(self, C: Matrix, known: KnownRms) -> float:
        """Bound of the root mean square of ‖C x‖."""
        return _root(self.state, C @ self.loop.inverse_weight, self.level(known))

    def bound_error(self, C: Matrix, known: KnownRms) -> float:
        """Bound of the root mean square of ‖C ê_c‖."""
        transformed = C @ self.loop.inverse_weight
        return _root(self.errors, np.hstack([transformed, transformed]), self.level(known))


def _root(form: Matrix, C: Matrix, level: float) -> float:
    """√(level · sup‖C z‖²/zᵀ form z)."""
    root = np.linalg.solve(np.linalg.cholesky(form), C.T)
    return float(np.linalg.norm(root, 2) * np.sqrt(level)) * _INFLATED


class LossyFlow:
    """The flow of (x, q, e_s) in the coordinates of W, of one loop under a schedule.

    Args:
        error: the gains of the models.
        plant: the gains of the plant; α of both is the same.
        conditions: conditions of the schedule; ``dropouts`` has no effect.
        probability: p̄.
        counts_age: whether the input's age is followed by itself, as v_h.
    """

    def __init__(
        self,
        error: ErrorGains,
        plant: PlantGains,
        conditions: NetworkConditions,
        probability: float,
        counts_age: bool = True,
    ) -> None:
        generators = plant.closed_loop, error.scaled_H
        self.decay_per_s = -max(spectral_abscissa(M) for M in generators)
        W, self.inverse_weight = error.weight, error.inverse_weight
        self.closed_loop, self.model = (W @ M @ self.inverse_weight for M in generators)
        self.probability = probability
        self.delay_s = conditions.delay_s
        self.start_s = conditions.start_s
        self.start = W @ plant.start[:, 0]
        delayed, aged = conditions.delay_s > 0, conditions.hold_s > 0
        self.counts_age = aged and counts_age
        self.inputs = np.array([delayed or aged or conditions.start_s > 0, delayed, self.counts_age])
        """Whether there is w, v_f and v_h."""
        self.age = conditions.hold_s * error.outputs[Output.GAIN_RATE] @ self.inverse_weight
        self.input = W @ plant.input_matrix
        self.gain = error.split_K[1] @ self.inverse_weight
        BK = self.input @ self.gain
        E = self.closed_loop - self.model
        zero = np.zeros_like(E)
        self.flow = np.block([
            [self.closed_loop, BK, BK],
            [zero, self.model, zero],
            [-E, -BK, self.model - BK],
        ])  # fmt: skip
        self.entering = np.vstack([self.input, 0 * self.input, -self.input])

    def bound_other_inputs(self, known: KnownRms) -> float:
        """Bound ω of w."""
        return known.other + (0.0 if self.counts_age else known.aged)

    def effect_in_flight(self, rate_per_s: float) -> Matrix:
        """Return D, (n, n), enlarged by the rounding of an exponential.

        The delay is halved until the models hardly move, then D(2t) = D(t) + e^{Mᵀt} D(t) e^{Mt}. One
        exponential would also have the growing e^{−Mᵀt}, in which D of a fast mode is lost.
        """
        n, M = len(self.model), self.model + rate_per_s * np.eye(len(self.model))
        halvings = int(np.ceil(np.log2(np.linalg.norm(M) * self.delay_s + 1)))
        square = self.gain.T @ self.gain
        both = exponential(np.block([[-M.T, square], [np.zeros((n, n)), M]]) * (self.delay_s / 2**halvings))
        moved = both[n:, n:]
        D = moved.T @ both[:n, n:]
        for _ in range(halvings):
            D, moved = D + moved.T @ D @ moved, moved @ moved
        return np.asarray((D + D.T) / 2 * _INFLATED)


def quadratic_functions(loop: LossyFlow, known: KnownRms) -> list[QuadraticFunction]:
    """Return functions V for several λ, each for a small bound of ‖x‖ or of ‖ê_c‖_W.

    There may be none: if nothing decays, each update is lost, there is no input, or because of rounding;
    and with many states, for which the search would take too long.
    """
    possible = loop.decay_per_s > 0 and loop.probability < 1 and loop.input.any() and known.sensor_error > 0
    if not possible or len(loop.model) > _MOST_STATES:
        return []
    zero = np.zeros_like(loop.model)
    searches = [_Search(loop, known, share, loop.inverse_weight, zero) for share in _OF_STATE]
    searches += [_Search(loop, known, share, zero, np.eye(len(zero))) for share in _OF_ERROR]
    return [function for search in searches if (function := search.find_function()) is not None]


class _Unknowns(NamedTuple):
    """X, P and the multipliers, where V ≤ 1 at all times and ‖e_s‖_W ≤ 1."""

    X: Matrix
    P: Matrix
    mu: float
    nu: float
    zetas: Vector
    """ζ, ζ_f and ζ_h; 0 for what there is not, (3,)."""
    gain: float
    """The bound of the output is its root's inverse."""


class _Search:
    """The inequalities for one λ, in a vector of unknowns."""

    def __init__(
        self, loop: LossyFlow, known: KnownRms, share: float, of_state: Matrix, of_error: Matrix
    ) -> None:
        self._loop = loop
        self._rate = share * loop.decay_per_s
        self._n = n = len(loop.model)
        self._sum = np.hstack([np.eye(n)] * 2)
        """(I I): q + e_s from (q, e_s)."""
        self._sensor = np.diag(np.repeat([0.0, 1.0], n))
        """The form ‖e_s‖² of (q, e_s)."""
        self._of_state = of_state
        self._of_error = of_error @ self._sum
        # The mean squares of w, then and at first, and x(0), for a = 1.
        unit = known.sensor_error
        self._other = (loop.bound_other_inputs(known) / unit) ** 2
        self._begun = (known.start / unit) ** 2 * loop.start_s
        self._start = loop.start / unit
        self._flight = loop.effect_in_flight(self._rate) if loop.delay_s > 0 else None

    def find_function(self) -> QuadraticFunction | None:
        """Return the function for the smallest bound that is found; None if it cannot be confirmed."""
        try:
            first = self._first_values()
            if first is None:
                return None
            solution = MatrixInequalities(self._blocks, len(first)).maximise_last(first)
        except np.linalg.LinAlgError:  # a matrix is singular to rounding
            return None
        if solution is None:
            return None
        X, P, mu, nu, zetas, _ = self._unknowns(solution)
        return QuadraticFunction(X, P + nu * self._sensor, nu, self._rate, mu, zetas, self._loop)

    def _unknowns(self, values: Vector) -> _Unknowns:
        n = self._n
        sizes = np.cumsum([n * (n + 1) // 2, n * (2 * n + 1)])
        of_state, of_errors, (mu, nu, *others, gain) = np.split(values, sizes)
        zetas = np.zeros(len(self._loop.inputs))
        zetas[self._loop.inputs] = others
        (X,), (P,) = from_triangles(of_state, n), from_triangles(of_errors, 2 * n)
        return _Unknowns(X, P, mu, nu, zetas, gain)

    def _values(self, unknowns: _Unknowns) -> Vector:
        X, P, mu, nu, zetas, gain = unknowns
        return np.array([*triangles(X), *triangles(P), mu, nu, *zetas[self._loop.inputs], gain])

    def _blocks(self, values: Vector) -> Blocks:
        """Return the numbers and matrices that are to be positive; affine in the values."""
        X, P, mu, nu, zetas, gain = unknowns = self._unknowns(values)
        n, rest = self._n, 1 - nu - zetas[0] * self._begun
        at_event = P - self._loop.probability * self._sum.T @ P[:n, :n] @ self._sum
        if self._flight is not None:
            at_event = at_event - zetas[1] * self._sum.T @ self._flight @ self._sum
        below = 2 * self._rate * rest - mu - zetas[0] * self._other
        traces = [_LARGEST - np.trace(X), _LARGEST - np.trace(P)]
        begin = rest - self._start @ X @ self._start
        return (
            np.array([below, begin, mu, nu, *traces, *zetas[self._loop.inputs]]),
            self._between_events(unknowns),
            at_event,
            P + nu * self._sensor - gain * self._of_error.T @ self._of_error,
            X - gain * self._of_state.T @ self._of_state,
        )

    def _between_events(self, unknowns: _Unknowns) -> Matrix:
        """Return the bound of V' + 2λV minus V' + 2λV, as a form of (x, q, e_s) and of w, v_f and v_h."""
        X, P, mu, _, zetas, _ = unknowns
        loop, n = self._loop, self._n
        V, entering = np.zeros((3 * n, 3 * n)), np.zeros((3 * n, 3 * n))
        V[:n, :n], V[n:, n:], entering[n:, n:] = X, P, mu * self._sensor
        form = entering - loop.flow.T @ V - V @ loop.flow - 2 * self._rate * V
        if loop.counts_age:
            aged = np.hstack([loop.age] * 3)
            form = form - zetas[2] * aged.T @ aged
        squares = zetas[loop.inputs]
        if not len(squares):
            return np.asarray(form)
        sides = np.hstack([-V @ loop.entering] * len(squares))
        squared = np.diag(np.repeat(squares, loop.entering.shape[1]))
        return np.asarray(np.block([[form, sides], [sides.T, squared]]))

    def _first_values(self) -> Vector | None:
        """Return values inside of all inequalities; None if rounding leaves none.

        q decays by itself, so a large P_qq covers what q does to x. A larger P_ss covers the events,
        ζ_f and ζ_h what v_f and v_h do to x, and large μ and ζ what e_s and w do. Then all is made small.
        """
        loop, p = self._loop, self._loop.probability
        X, root = self._state_form()
        Q = _decaying_form(loop.model, (self._rate + loop.decay_per_s) / 2)
        if root is None:
            return None
        # How large P_qq must be for what q does to x, and P_ss for the events.
        pushed = np.linalg.solve(root, X @ loop.input)
        of_flight = 8 * float(np.linalg.norm(pushed, 2)) ** 2
        left = np.linalg.cholesky(self._decay(loop.model, Q))
        couplings = (pushed @ loop.gain).T, np.linalg.solve(root, loop.age.T @ loop.age).T, loop.age.T
        size = float(np.trace(X) / np.trace(Q))
        size += 8 * sum(float(np.linalg.norm(np.linalg.solve(left, C), 2)) ** 2 for C in couplings)
        P = np.asarray(np.kron(np.diag([1.0, 2 * p / (1 - p) + 1.0]), Q), np.float64)
        if self._flight is not None:
            lost, taken = (self._sum.T @ form @ self._sum for form in (p * Q, self._flight))
            size += 2 * of_flight * float(np.linalg.norm(np.linalg.solve(P - lost, taken), 2))
        P, large = P * size, size
        # μ and ζ that are large enough for what e_s and w do.
        while True:
            zetas = np.where(loop.inputs, [large, of_flight, 1.0], 0.0)
            begin = _Unknowns(X, P, large, large, zetas, 0.0)
            if is_positive(self._between_events(begin)):
                break
            large *= 4
            if not np.isfinite(large):
                return None
        # A small gain, and all divided by so much that V and the traces are small enough.
        least = min(float(np.linalg.eigvalsh(form)[0]) for form in (X, P))
        gain = least / (1 + float(np.linalg.norm(self._of_state) ** 2 + np.linalg.norm(self._of_error) ** 2))
        level = large * (1 + self._begun + (1 + self._other) / (2 * self._rate))
        level += float(self._start @ X @ self._start + np.trace(X) + np.trace(P))
        first = self._values(begin._replace(gain=gain)) / (4 * level)
        return first if all(map(is_positive, self._blocks(first))) else None

    def _state_form(self) -> tuple[Matrix, Matrix | None]:
        """X that decays, and a root of what is left of its decay; ζ_h = 1 covers the input's age.

        It is that of the bounded real lemma, which exists if age and input amplify by less than 1.
        """
        loop = self._loop
        X = _decaying_form(loop.closed_loop, (self._rate + loop.decay_per_s) / 2)
        left = self._decay(loop.closed_loop, X)
        if loop.counts_age:
            from scipy.linalg import solve_continuous_are  # slow to import

            flow = loop.closed_loop + self._rate * np.eye(self._n)
            aged, identity = loop.age.T @ loop.age, np.eye(loop.input.shape[1])
            remaining = aged + _LEFT * (np.linalg.norm(aged, 2) + 1e-9) * np.eye(self._n)
            try:
                X = np.asarray(solve_continuous_are(flow, loop.input, remaining, -identity / (1 + _LEFT)))
            except (np.linalg.LinAlgError, ValueError):
                return X, None
            left = self._decay(loop.closed_loop, X) - aged - X @ loop.input @ loop.input.T @ X
        has_root = is_positive(left) and is_positive(X)
        return X, np.asarray(np.linalg.cholesky(left)) if has_root else None

    def _decay(self, M: Matrix, form: Matrix) -> Matrix:
        """Return the decay of a form along z' = M z that is left beside the rate λ."""
        return np.asarray(-(M.T @ form + form @ M) - 2 * self._rate * form)


def _decaying_form(M: Matrix, rate_per_s: float) -> Matrix:
    """Return a form that decays along z' = M z at a rate of more than twice the given one."""
    flow, identity = (M + rate_per_s * np.eye(len(M))).T, np.eye(len(M))
    both_sides = np.kron(flow, identity) + np.kron(identity, flow)
    form = np.linalg.solve(both_sides, -identity.ravel()).reshape(M.shape)
    return np.asarray((form + form.T) / 2)
