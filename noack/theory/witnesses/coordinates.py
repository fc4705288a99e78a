"""Coordinates in which the solver succeeds: second moments of random runs of the hybrid system.

The runs are rough: steps of one test, inputs of some age, random losses and delays, disturbances that
change their signs. They only have to show how large the states are where they are.
"""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from flint import arb, arb_mat, fmpq
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.core.linear_systems import Matrix, Vector
from noack.proof.elaborate.hybrid_system import Model
from noack.theory.witnesses.effort import NoWitnessError

Frames = Mapping[str, Matrix]
"""By the name of a witness's matrix V: T with V = T⁻ᵀ V̂ T⁻¹, V̂ of order 1."""
MEMORY = "y"
"""The name of the unit of a rule's memory."""
_RUNS, _MOST_STEPS = 120, 3000
_STEPS = 16
"""At least, of the period of a periodic rule."""
_SLOW = 3.0
"""Where the model is so exact that e_s seldom reaches the threshold, it begins there."""
_LOSS_RATES = (0.0, 0.3, 0.6, 0.9, 1.0)


def floats(M: arb_mat) -> Matrix:
    """Return the midpoints.

    Raises:
        NoWitnessError: one is beyond all floats, as e^(−As) of a stiff model and an old input.
    """
    values = np.array([float(v) for v in M.entries()]).reshape(M.nrows(), M.ncols())
    if not np.isfinite(values).all():
        raise NoWitnessError("the loop's inequalities have numbers larger than 1e308")
    return values


def simulated_frames(model: Model) -> Frames:
    """Return coordinates for the matrices of a model's forms, in units of the threshold."""
    runs = _Runs(model)
    runs.advance()
    frames: dict[str, Matrix] = {}
    for index, place in enumerate(model.locations):
        own = runs.moments(place.name.partition(", ")[0])
        for node in range(len(place.nodes)):
            for name, S in model.form(index, node).parts:
                where = [place.coordinates[int(np.flatnonzero(row)[0])] for row in floats(S)]
                block = (runs.moments("") if name.startswith("X") else own)[np.ix_(where, where)]
                if model.counted:  # e_s is small after an event, so in units of what each entry is then
                    then = runs.moments_after(max(model.silent_tests(index), 1))[np.ix_(where, where)]
                    if (sizes := np.sqrt(np.diag(then))).all():
                        correlation = then / np.outer(sizes, sizes) + 0.3 * np.eye(len(sizes))
                        frames[name] = 2 * sizes[:, None] * _root(correlation)
                        continue
                frames[name] = 2 * _root(block + 0.3 * np.diag(np.diag(block)))
    if model.memory is not None:
        frames[MEMORY] = 2 * np.sqrt(runs.moments("")[np.ix_(runs.memory, runs.memory)])
    return frames


def _root(M: Matrix) -> Matrix:
    """Return an invertible T with TTᵀ near M, also where M is singular, 0 or no number."""
    if not np.isfinite(M).all() or not M.any():
        return np.eye(len(M))
    values, vectors = np.linalg.eigh((M + M.T) / 2)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 1e-4 * values[-1])))


class _Runs:
    """Random runs of a model, of which the second moments by location are kept."""

    def __init__(self, model: Model) -> None:
        self._loop, n, N = model.loop, model.loop.n, model.size
        self._rng = np.random.default_rng(0)
        flows = [floats(flow.matrix) for flow in model.locations[0].flows]
        moving = n - self._loop.loads
        closed = flows[0][:moving, :moving]
        fastest = max(float(np.abs(np.linalg.eigvals(M)).max()) for M in (*flows, closed))
        slowest = max(-float(np.linalg.eigvals(closed).real.max()), 1e-3)
        self._period_s = _seconds(self._loop.times.period)
        self._h = _seconds(self._loop.times.sampling) or (0.02 if self._loop.holds else 0.1) / fastest
        if self._period_s:
            self._h = self._period_s / max(round(self._period_s / self._h), _STEPS)
        self._steps = int(min(max(6.0 / slowest / self._h, 200), _MOST_STEPS))
        self._sway = self._h * slowest * np.array([0.3, 1.0, 3.0])
        self._exact = [expm(flow * self._h) for flow in flows]
        self._corner = self._rng.integers(0, len(flows), _RUNS)
        unknowns = model.locations[0].flows[0].unknowns
        self._columns = np.array([floats(u.column)[:, 0] for u in unknowns]).reshape(-1, N)
        self._sizes = np.array([floats(u.rows)[0] for u in unknowns]).reshape(-1, N)
        self._noise = np.flatnonzero(floats(model.p).any(axis=0))
        self._silent, self._unit = floats(model.silent), floats(model.threshold_squared())
        self._sent = [self._jump_matrix(model, later, arrives=False) for later in range(model.later + 1)]
        self._used = [self._jump_matrix(model, later, arrives=True) for later in range(model.later + 1)]
        self._z = np.ones((_RUNS, N))
        self._z[:, n : N - 2] = 0
        self._z[:, :n] = floats(self._loop.start)[:, 0]
        smooth = np.flatnonzero(floats(model.s).any(axis=0))
        self._z[:, smooth] = floats(model.bounds.smooth.start)[:, 0][: len(smooth)]
        spread = float(np.linalg.norm(floats(self._loop.start))) or 1.0
        half = _RUNS // 2
        self._z[half:, :moving] = spread * self._rng.standard_normal((_RUNS - half, moving)) / np.sqrt(moving)
        W, threshold = floats(self._loop.weight), float(np.sqrt(self._unit.sum()))
        if (
            model.sees_all
            and np.linalg.norm(W @ flows[0][n : 2 * n, :n]) * spread < _SLOW * slowest * threshold
        ):
            errors = self._rng.standard_normal((_RUNS - half, n)) @ np.linalg.inv(W).T
            self._z[half:, n : 2 * n] = threshold / np.sqrt(n) * errors
        self.memory = np.flatnonzero(floats(model.y).any(axis=0))
        """The place of y in z, if there is one."""
        self._remembered, self._after_event = (
            floats(model.memory_after_test(resets=resets)) for resets in (False, True)
        )
        self._z[:, self.memory] = model.memory_at_start
        self._z[:, self.memory] = self._next_memory(np.ones(_RUNS, bool))
        self._since_event, self._dwell = np.zeros(_RUNS), _seconds(self._loop.times.dwell)
        self._missing = np.zeros(_RUNS, int)
        self._later, self._most = np.zeros(_RUNS, int), model.later
        self._waiting = np.zeros(_RUNS, bool)
        self._loss_rate = self._rng.choice(_LOSS_RATES, _RUNS)
        self._silent_sums = np.zeros((model.counted + 1, N, N))
        self._silent_counts = np.zeros(model.counted + 1)
        self._sums: dict[str, Matrix] = defaultdict(lambda: np.zeros((N, N)))
        self._counts: dict[str, int] = defaultdict(int)

    @staticmethod
    def _jump_matrix(model: Model, later: int, *, arrives: bool) -> Matrix:
        """Return the jump of an event, or of an input, if an update with so many later ones is on its way."""
        if arrives and model.is_periodic:
            return floats(model.jump(model.e + (model.v[0] if later else 0 * model.w), 0 * model.w, ()))
        if arrives:
            return floats(model.jump(model.e, model.v[0] if later else 0 * model.w, ()))
        added = model.e - model.noise
        copies = [*(v + added for v in model.v[:later]), added][: len(model.v)]
        return floats(model.jump(model.noise, model.w + added, copies))

    def advance(self) -> None:
        """Simulate all steps."""
        for step in range(self._steps):
            self._flow(step)
            self._z[:, self._noise] = self._rng.choice([-1.0, 1.0], (_RUNS, len(self._noise)))
            event = self._events(step)
            remembered = self._next_memory(event)
            self._jump(event)
            self._z[:, self.memory] = remembered
            self._observe()

    def moments(self, location: str) -> Matrix:
        """Return the second moments in a location, mixed with those of all; of all for ""."""
        total = np.sum(list(self._sums.values()), axis=0) / sum(self._counts.values())
        if location not in self._sums:
            return np.asarray(total)
        return np.asarray(0.7 * self._sums[location] / self._counts[location] + 0.3 * total)

    def moments_after(self, silent: int) -> Matrix:
        """Return the second moments of all locations after some silent tests since an event."""
        return np.asarray(self._silent_sums[silent] / max(self._silent_counts[silent], 1))

    def _flow(self, step: int) -> None:
        moved = np.empty_like(self._z)
        for index, E in enumerate(self._exact):
            moved[self._corner == index] = self._z[self._corner == index] @ E.T
        if len(self._columns):
            phases = step * self._rng.choice(self._sway, len(self._columns)) + np.arange(_RUNS)[:, None]
            pushes = np.sign(np.sin(phases)) * np.abs(self._z @ self._sizes.T)
            moved += self._h * pushes @ self._columns
        self._z = moved

    def _events(self, step: int) -> NDArray[np.bool_]:
        if self._period_s:
            return np.full(_RUNS, (step + 1) % round(self._period_s / self._h) == 0)
        self._since_event += self._h
        event = (self._quadratic(self._silent) > 0) & (self._since_event > self._dwell - self._h / 2)
        self._since_event[event] = 0
        return event

    def _next_memory(self, event: NDArray[np.bool_]) -> Matrix:
        """Return y of all runs after tests, (_RUNS, 1)."""
        eta = np.where(event, self._quadratic(self._after_event), self._quadratic(self._remembered))
        return np.sqrt(np.maximum(eta, 0.0))[:, None]

    def _jump(self, event: NDArray[np.bool_]) -> None:
        z, delay_s = self._z, _seconds(self._loop.times.delay)
        arrives = self._waiting & (self._rng.random(_RUNS) < 2.0 * self._h / max(delay_s, self._h))
        self._arrive(arrives | self._waiting & event & (self._later >= self._most))
        drops = event & (self._rng.random(_RUNS) < self._loss_rate) & (self._missing < self._loop.losses)
        resets = event & ~(drops & ~self._waiting) if self._period_s else event
        for later, matrix in enumerate(self._sent):
            these = resets & (self._later == later)
            z[these] = z[these] @ matrix.T
        self._later[event & self._waiting] += 1
        self._missing[drops & ~self._waiting] += 1
        passes = event & ~drops
        if delay_s:
            self._waiting |= passes
        else:
            self._arrive(passes)

    def _arrive(self, which: NDArray[np.bool_]) -> None:
        for later, matrix in enumerate(self._used):
            these = which & (self._later == later)
            self._z[these] = self._z[these] @ matrix.T
        self._waiting &= ~which
        self._missing[which] = self._later[which] = 0

    def _observe(self) -> None:
        """Add to the moments, in units of the present threshold; without one, of the decay."""
        size = self._quadratic(self._unit)
        decay = self._z[:, -2] ** 2
        unit = float(self._unit.sum()) or 1.0
        ratio = np.maximum(size / unit if size.any() else decay, 1e-300)
        scaled = self._z / np.sqrt(ratio)[:, None]
        if (most := len(self._silent_counts) - 1) > 0:
            silent = np.minimum(np.rint(self._since_event / self._h).astype(int), most)
            np.add.at(self._silent_sums, silent, scaled[:, :, None] * scaled[:, None, :])
            np.add.at(self._silent_counts, silent, 1)
        for lost in range(self._loop.losses + 1):
            self._add(f"{lost} lost", scaled[(self._missing == lost) & ~self._waiting])
        for later in range(self._most + 1):
            self._add(f"{later} later", scaled[(self._later == later) & self._waiting])

    def _add(self, location: str, z: Matrix) -> None:
        if len(z):
            self._sums[location] += z.T @ z
            self._counts[location] += len(z)

    def _quadratic(self, M: Matrix) -> Vector:
        return np.asarray((self._z @ M * self._z).sum(1))


def _seconds(time: fmpq) -> float:
    return float(arb(time).mid())
