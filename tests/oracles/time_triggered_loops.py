"""Time-triggered loops under loss patterns that are repeated; independent of the project's margins.

The loop is followed from each change (a step of the plant, a tick of the controller, an arrival) to
the next by matrix exponentials. The patterns are all short ones that the guarantee allows, random
longer ones, and those found by changing single updates of the worst one.
"""

from collections.abc import Sequence
from functools import reduce
from itertools import product

import numpy as np
from scipy.linalg import eig, expm

from noack.core.linear_systems import Matrix, Vector
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from tests.oracles.loss_language import allowed_rows
from tests.oracles.lossy_loops import Flags, Reals, Steps

_SHORT, _LONG, _RANDOM, _ROUNDS = 7, 12, 64, 3
_WINDOW = 40
"""Updates for which a repeated pattern is compared with the guarantee."""
_DOUBLINGS = 40


class LoopMaps:
    """The maps of a resolved loop from each update to the next one.

    Two updates are between ``least`` and ``most`` units apart; a unit is the time between two
    measurements, or the period if the two are 1. In patterns, (patterns, updates), each update has
    a choice: the number of units, from ``least`` on; or with a period the slot, its place relative
    to the controller's ticks. The age of x_c is counted in units, up to one at which it is too old.
    """

    def __init__(self, resolved: Scenario, unit_ns: int, least: int = 1, most: int = 1) -> None:
        self.resolved, self.unit_ns, self.least, self.is_periodic = resolved, unit_ns, least, most == 1
        loop, timing = loop_of(resolved), resolved.timing
        # The times of the loop.
        self._step_ns, self._tick_ns = timing.plant_period_ns, timing.controller_period_ns
        self._phase_ns, n, m = timing.controller_phase_ns, loop.n, loop.m
        self._delay_ns = sum(round(impairment.delay_s * 1e9) for impairment in resolved.network.impairments)
        # The rates of z = (x, x_c, u, w, s), and its jumps at a step, event, arrival and tick. w is the
        # input of the next step. s is x in the newest update that is not lost; it may not have arrived yet.
        x, x_c, u, w, s = np.split(np.eye(3 * n + 2 * m), np.cumsum([n, n, m, m]))
        self._rates = np.vstack([loop.A @ x + loop.B @ u, loop.H @ x_c, 0 * u, 0 * w, 0 * s])
        arrived = expm(loop.H * self._delay_ns * 1e-9) @ s
        self._step, self._send = np.vstack([x, x_c, w, w, s]), np.vstack([x, x_c, u, w, x])
        controller = resolved.controller
        self._arrive = np.vstack([x, arrived, u, w, s])
        without = w if controller.timeout_input == "hold" else 0 * w
        self._ticks = [np.vstack([x, x_c, u, sent, s]) for sent in (loop.K @ x_c, without)]
        # How old x_c may become.
        timeout_s = controller.update_timeout_s
        self._timeout_ns = 2**62 if timeout_s is None else round(timeout_s * 1e9)
        self._oldest = 1 if timeout_s is None else -(-self._timeout_ns // unit_ns)
        # The map of each interval: by choice, age before, and whether the update is delivered.
        cycle_ns = int(np.lcm(self._step_ns, self._tick_ns))
        slots = cycle_ns // int(np.gcd(cycle_ns, unit_ns))
        assert self.is_periodic or slots == 1
        lengths = [1] * slots if self.is_periodic else range(least, most + 1)
        self._maps = np.array([
            [[self._interval(choice, length, age, delivered) for delivered in (False, True)]
             for age in range(1, self._oldest + 1)]
            for choice, length in enumerate(lengths)
        ])  # fmt: skip
        self._lengths = np.array(lengths)
        self._times = self._lengths / (1 if self.is_periodic else most)

    def cost(self, x0: Vector, Q: Matrix, R: Matrix) -> float:
        """Return ∫ xᵀQx + uᵀRu dt without losses, from x(0), which the controller knows."""
        n, m = len(Q), len(R)
        weight, form, whole = np.zeros_like(self._rates), 0 * self._rates, np.eye(len(self._rates))
        weight[:n, :n], weight[2 * n : 2 * n + m, 2 * n : 2 * n + m] = Q, R
        nodes, shares = np.polynomial.legendre.leggauss(8)
        for slot in range(len(self._maps)):
            for dt_s, change in self._changes(slot, 1, delivered=True):
                for node, share in zip(nodes, shares, strict=True):
                    there = expm(self._rates * dt_s * (1 + node) / 2) @ whole
                    form += share * dt_s / 2 * there.T @ weight @ there
                whole = change @ expm(self._rates * dt_s) @ whole
        if np.abs(np.linalg.eigvals(whole)).max() >= 1:
            return np.inf
        for _ in range(_DOUBLINGS):
            form, whole = form + whole.T @ form @ whole, whole @ whole
        z0 = np.concatenate([x0, x0, np.zeros(2 * m), x0])
        return float(z0 @ form @ z0)

    def growth_of(self, pattern: Sequence[bool], intervals_s: Sequence[float]) -> float:
        """Return how much a pattern grows at most, from the first update on; 0 if it is not allowed."""
        lost = ~np.array([pattern], bool)
        if not self._is_allowed(lost):
            return 1e-300
        repeated, choices = self._repeated(lost, np.random.default_rng(0))
        if not self.is_periodic:
            choices = np.rint([np.array(intervals_s) * 1e9 / self.unit_ns]).astype(int) - self.least
        return self._limits(repeated, choices)[1]

    def worst_pattern(self, rng: np.random.Generator) -> tuple[int, float]:
        """Return the number of patterns tried, and how much the worst one grows at least.

        The growth is that per longest time between updates.
        """
        tried, growth = 0, -1.0
        worst = repeated = choices = np.zeros((1, 1), int)

        def examine(lost: Flags) -> None:
            nonlocal tried, growth, worst, repeated, choices
            allowed = lost[self._is_allowed(lost)]
            if len(allowed):
                outcomes, chosen = self._repeated(allowed, rng)
                radii = np.abs(np.linalg.eigvals(self._products(outcomes, chosen))).max(axis=1)
                growths = radii ** (1 / self._times[chosen].sum(axis=1))
                tried, first = tried + len(allowed), int(growths.argmax())
                if growths[first] > growth:
                    growth, here = float(growths[first]), slice(first, first + 1)
                    worst, repeated, choices = allowed[here], outcomes[here], chosen[here]

        for length in range(1, _SHORT + 1):
            examine(np.array(list(product([False, True], repeat=length))))
        examine(rng.random((_RANDOM, _LONG)) < rng.random((_RANDOM, 1)))
        for _ in range(_ROUNDS):
            examine(worst ^ np.eye(worst.shape[1], dtype=bool))
        return tried, self._limits(repeated, choices)[0]

    def _changes(self, slot: int, age: int, delivered: bool) -> list[tuple[float, Reals]]:
        """Return what happens in one unit: the time in s since the change before, and the change."""
        begin_ns, end_ns = slot * self.unit_ns, (slot + 1) * self.unit_ns

        def tick(t_ns: int) -> Reals:
            has_arrived = delivered and t_ns >= begin_ns + self._delay_ns
            update_ns = begin_ns if has_arrived else begin_ns - age * self.unit_ns
            return self._ticks[t_ns - update_ns >= self._timeout_ns]

        first_ns = begin_ns + (self._phase_ns - begin_ns) % self._tick_ns
        steps_ns = range(begin_ns + self._step_ns, end_ns + 1, self._step_ns)
        changes = [(t_ns, 0, self._step) for t_ns in steps_ns]
        changes += [(t_ns, 3, tick(t_ns)) for t_ns in range(first_ns, end_ns, self._tick_ns)]
        if delivered:
            changes += [(begin_ns, 1, self._send), (begin_ns + self._delay_ns, 2, self._arrive)]
        times_ns, _, whats = zip(*sorted(changes, key=lambda change: change[:2]), strict=True)
        return list(zip(np.diff(times_ns, prepend=begin_ns) * 1e-9, whats, strict=True))

    def _interval(self, choice: int, length: int, age: int, delivered: bool) -> Reals:
        """Return the map from an update to the next one, some units later."""
        slot, maps = choice if self.is_periodic else 0, []
        for _ in range(length):
            changes = self._changes(slot, age, delivered)
            maps += [change @ expm(self._rates * dt_s) for dt_s, change in changes]
            age, delivered = 1 if delivered else age + 1, False
        return reduce(lambda before, map_: map_ @ before, maps)

    def _chosen(self, lost: Flags, choices: Steps) -> Reals:
        """Return the maps of repeated patterns, (patterns, updates, size, size)."""
        age, ages = np.full(len(lost), self._oldest), np.zeros(lost.shape, int)
        for k in [*range(lost.shape[1])] * 2:
            ages[:, k] = np.minimum(age, self._oldest)
            age = np.where(lost[:, k], age, 0) + self._lengths[choices[:, k]]
        return self._maps[choices, ages - 1, (~lost).astype(int)]

    def _is_allowed(self, lost: Flags) -> Flags:
        """Whether each pattern keeps the guarantee if it is repeated."""
        return allowed_rows(np.tile(lost, -(-_WINDOW // lost.shape[1])), self.resolved.network.link)

    def _repeated(self, lost: Flags, rng: np.random.Generator) -> tuple[Flags, Steps]:
        """Return the outcomes until the slots repeat, too, and choices, random without a period."""
        if self.is_periodic:
            lost = np.tile(lost, int(np.lcm(lost.shape[1], len(self._maps))) // lost.shape[1])
            return lost, np.broadcast_to(np.arange(lost.shape[1]) % len(self._maps), lost.shape)
        last = len(self._maps) - 1
        choices = rng.integers(0, last + 1, lost.shape)
        return lost, np.where(rng.random((len(lost), 1)) < 0.5, last, choices)

    def _products(self, lost: Flags, choices: Steps) -> Reals:
        maps = self._chosen(lost, choices).swapaxes(0, 1)
        return reduce(lambda before, map_: map_ @ before, maps)

    def _limits(self, lost: Flags, choices: Steps) -> tuple[float, float]:
        """Return what the growth of one pattern is at least and at most, with rounding."""
        values, left, right = eig(self._products(lost, choices)[0], left=True)
        sizes = np.linalg.norm(self._chosen(lost, choices), axis=(-2, -1))
        first, power = int(np.abs(values).argmax()), 1 / self._times[choices].sum()
        radius = abs(values[first])
        error = 1e-15 * sizes.prod() / abs(np.vdot(left[:, first], right[:, first]))
        return float(max(radius - error, 0.0) ** power), float((radius + error) ** power)
