"""Margins: the growth of repeated loss patterns against the certified bounds of all patterns.

The loop is followed from each change (a step of the plant, a tick of the controller, an arrival) to
the next by matrix exponentials. The patterns are all short ones that the guarantee allows, random
longer ones, and those found by changing single updates of the worst one. The pattern of the lower
bound is repeated from the first update on.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.linalg import eig, expm

from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.impairments.loss_guarantee import LossGuarantee
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.margins import loss_margin
from noack.theory.margins.joint_spectral_radius import JointSpectralRadius
from noack.theory.margins.loss_margin import LossMargin, Stability, capped, intervals_ns
from noack.theory.margins.switched_system import Edge, SwitchedSystem, find_cycle
from tests.noack.theory.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificate_kinds.policies import scenario_of
from tests.noack.theory.certificate_kinds.shares import Case, drawn, shares_of
from tests.oracles.loss_language import allowed_rows
from tests.oracles.lossy_loops import Flags, Reals, Steps, random_system

_SHORT, _LONG, _RANDOM, _ROUNDS = 7, 12, 64, 3
_ACCURACY = 0.01
_DOUBLINGS = 40
_WINDOW = 40
"""Updates for which a repeated pattern is compared with the guarantee."""


class LoopMaps:
    """The maps of the loop over the times between updates: ``most`` and at least ``least`` units."""

    def __init__(self, resolved: Scenario, unit_ns: int, least: int = 1, most: int = 1) -> None:
        self.resolved, self.unit_ns, self.least = resolved, unit_ns, least
        self.is_periodic = most == 1
        loop, timing, (n, m) = loop_of(resolved), resolved.timing, loop_of(resolved).B.shape
        self._step_ns, self._tick_ns = timing.plant_period_ns, timing.controller_period_ns
        self._phase_ns = timing.controller_phase_ns
        self._delay_ns = sum(round(one.delay_s * 1e9) for one in resolved.network.impairments)
        # s is x in the newest update that is not lost; it may not have arrived yet.
        x, x_c, u, w, s = np.split(np.eye(3 * n + 2 * m), np.cumsum([n, n, m, m]))
        self._rates = np.vstack([loop.A @ x + loop.B @ u, loop.H @ x_c, 0 * u, 0 * w, 0 * s])
        arrived = expm(loop.H * self._delay_ns * 1e-9) @ s
        self._step, self._send = np.vstack([x, x_c, w, w, s]), np.vstack([x, x_c, u, w, x])
        self._arrive, self._tick = np.vstack([x, arrived, u, w, s]), np.vstack([x, x_c, u, loop.K @ x_c, s])
        cycle_ns = int(np.lcm(self._step_ns, self._tick_ns))
        slots = cycle_ns // int(np.gcd(cycle_ns, unit_ns))
        units = [[self._unit(slot, delivered) for delivered in (False, True)] for slot in range(slots)]
        if not self.is_periodic:
            assert slots == 1
            later = [np.linalg.matrix_power(units[0][0], k - 1) for k in range(least, most + 1)]
            units = [[one @ first for first in units[0]] for one in later]
        self.maps = np.array(units)
        """By choice, the slot or the time to the next update, and whether it is delivered."""
        self._times = np.ones(slots) if self.is_periodic else np.arange(least, most + 1) / most

    def _changes(self, slot: int, delivered: bool) -> list[tuple[float, Reals]]:
        """Return what happens in one unit: the time in s since the change before, and the change."""
        begin_ns, end_ns = slot * self.unit_ns, (slot + 1) * self.unit_ns
        first_ns = begin_ns + (self._phase_ns - begin_ns) % self._tick_ns
        steps_ns = range(begin_ns + self._step_ns, end_ns + 1, self._step_ns)
        changes = [(t_ns, 0, self._step) for t_ns in steps_ns]
        changes += [(t_ns, 3, self._tick) for t_ns in range(first_ns, end_ns, self._tick_ns)]
        if delivered:
            changes += [(begin_ns, 1, self._send), (begin_ns + self._delay_ns, 2, self._arrive)]
        times_ns, _, whats = zip(*sorted(changes, key=lambda one: one[:2]), strict=True)
        return list(zip(np.diff(times_ns, prepend=begin_ns) * 1e-9, whats, strict=True))

    def _unit(self, slot: int, delivered: bool) -> Reals:
        whole = np.eye(len(self._rates))
        for dt_s, change in self._changes(slot, delivered):
            whole = change @ expm(self._rates * dt_s) @ whole
        return whole

    def cost(self, x0: Vector, Q: Matrix, R: Matrix) -> float:
        """Return ∫ xᵀQx + uᵀRu dt without losses, from x(0), which the controller knows."""
        n, m = len(Q), len(R)
        weight, form, whole = np.zeros_like(self._rates), 0 * self._rates, np.eye(len(self._rates))
        weight[:n, :n], weight[2 * n : 2 * n + m, 2 * n : 2 * n + m] = Q, R
        nodes, shares = np.polynomial.legendre.leggauss(8)
        for slot in range(len(self.maps)):
            for dt_s, change in self._changes(slot, delivered=True):
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

    def repeated(self, lost: Flags, rng: np.random.Generator) -> tuple[Flags, Steps]:
        """Return outcomes until the slots repeat, and choices, of patterns (patterns, updates)."""
        if not self.is_periodic:
            last = len(self.maps) - 1
            choices = rng.integers(0, last + 1, lost.shape)
            return lost, np.where(rng.random((len(lost), 1)) < 0.5, last, choices)
        lost = np.tile(lost, int(np.lcm(lost.shape[1], len(self.maps))) // lost.shape[1])
        return lost, np.broadcast_to(np.arange(lost.shape[1]) % len(self.maps), lost.shape)

    def growth(self, lost: Flags, choices: Steps) -> Reals:
        """Return the growth of each pattern per longest time between updates, up to rounding."""
        maps, whole = self.maps[choices, (~lost).astype(int)], np.eye(len(self._rates))
        for step in maps.swapaxes(0, 1):
            whole = step @ whole
        return np.abs(np.linalg.eigvals(whole)).max(axis=1) ** (1 / self._times[choices].sum(axis=1))

    def growth_limits(self, lost: Flags, choices: Steps) -> tuple[float, float]:
        """Return what the growth of one pattern is at least and at most, with rounding."""
        maps, whole = self.maps[choices, (~lost).astype(int)], np.eye(len(self._rates))
        for step in maps:
            whole = step @ whole
        values, left, right = eig(whole, left=True)
        first, sizes = int(np.abs(values).argmax()), np.linalg.norm(maps, axis=(1, 2))
        error = 1e-15 * sizes.prod() / abs(np.vdot(left[:, first], right[:, first]))
        power = 1 / self._times[choices].sum()
        return max(abs(values[first]) - error, 0.0) ** power, (abs(values[first]) + error) ** power

    def growth_of(self, found: Stability) -> float:
        """Return what the pattern of a lower bound grows at most; 0 if it is not allowed."""
        lost = ~np.array([found.pattern])
        if not is_allowed(lost, self.resolved):
            return 1e-300
        lost, choices = self.repeated(lost, np.random.default_rng(0))
        if not self.is_periodic:
            units = np.rint(np.array(found.intervals_s) * 1e9 / self.unit_ns).astype(int)
            choices = units[None] - self.least
        return self.growth_limits(lost[0], choices[0])[1]


def is_allowed(lost: Flags, resolved: Scenario) -> Flags:
    """Whether each pattern keeps the guarantee if it is repeated."""
    return allowed_rows(np.tile(lost, -(-_WINDOW // lost.shape[1])), resolved.network.link)


def worst_pattern(loop: LoopMaps, rng: np.random.Generator) -> tuple[int, Flags, Steps]:
    """Return the number of patterns tried, and the outcomes and choices that grow most."""
    runs, best, worst = 0, -1.0, None

    def examine(lost: Flags) -> None:
        nonlocal runs, best, worst
        allowed = lost[is_allowed(lost, loop.resolved)]
        if not len(allowed):
            return
        repeated, choices = loop.repeated(allowed, rng)
        growth = loop.growth(repeated, choices)
        fastest, runs = int(growth.argmax()), runs + len(allowed)
        if growth[fastest] > best:
            best, worst = float(growth[fastest]), (allowed[fastest], repeated[fastest], choices[fastest])

    for length in range(1, _SHORT + 1):
        examine(np.array(list(product([False, True], repeat=length))))
    examine(rng.random((_RANDOM, _LONG)) < rng.random((_RANDOM, 1)))
    for _ in range(_ROUNDS):
        lost = worst[0]
        examine(lost ^ np.eye(len(lost), dtype=bool))
    return runs, *worst[1:]


def random_scenario(rng: np.random.Generator, **fixed: Any) -> tuple[Scenario, int, int, int]:
    """A loop with periodic updates, or events; its unit in ns, least and most units between two."""
    periodic, share = fixed.pop("periodic", rng.random() < 0.75), rng.choice([0.05, 0.2])
    delayed = fixed.pop("delayed", float(rng.choice([0.0, 0.0, 0.3, 0.99])))
    given = {
        "n": int(rng.choice([1, 2, 2, 3])), "step_share": share, "mansd": int(rng.integers(0, 5)),
        "window": [(1, 1), (1, 1), (1, 4), (2, 5)][rng.integers(4)],
        "recovery": int(rng.choice([0, 0, 1, 3])),
    }  # fmt: skip
    system = random_system(rng, **(given | fixed))
    grows_per_s = rng.uniform(-0.5, 1.5)
    if "rate_per_s" in fixed:
        grows_per_s = fixed["rate_per_s"] - spectral_abscissa(system.A)
    A = system.A + grows_per_s * np.eye(len(system.A))
    system = replace(system, A=A, H=system.H * rng.integers(2))
    step_ns, every = round(system.step_s * 1e9 / 12) * 12, int(rng.integers(1, 4))
    unit_ns = step_ns * every
    least, most = fixed.pop("apart", sorted(rng.integers(1, 4, 2).tolist()))
    if periodic or most == 1:
        unit_ns, least, most = unit_ns * int(rng.integers(1, 9)), 1, 1
        trigger: dict[str, Any] = {"policy": "periodic", "period_s": unit_ns * 1e-9}
        ticks_ns = [step_ns * twelfths // 12 for twelfths in (4, 6, 12, 18, 24)]
    else:
        rule = {"policy": "dwell", "interval_s": (least - 0.5) * unit_ns * 1e-9}
        rule["rule"] = {"policy": "absolute", "delta": 1.0}
        trigger = {"policy": "deadline", "interval_s": (most - 0.5) * unit_ns * 1e-9, "rule": rule}
        ticks_ns = [step_ns, unit_ns]
    tick_ns = int(rng.choice(ticks_ns))
    delay_s = delayed * unit_ns * 1e-9
    (losses, window), recovery = system.window, system.recovery
    constraints = [{"kind": "at_most", "losses": losses, "window": window}] * (losses < window)
    constraints += [{"kind": "recovery", "deliveries": recovery}] * (recovery > 0)
    scenario = scenario_of(
        system, trigger, model={"allow_unstable": True},
        plant={"rate_hz": 1e9 / step_ns, "measure_every": every},
        controller={"rate_hz": 1e9 / tick_ns, "phase": float(rng.choice([0.0, 0.25, 0.5]))},
        network={
            "constraints": constraints,
            "impairments": [{"kind": "delay", "delay_s": delay_s}] * (delay_s > 0),
        },
    )  # fmt: skip
    return scenario, unit_ns, least, most


def random_loop(rng: np.random.Generator, **fixed: Any) -> LoopMaps:
    """The same, with its maps."""
    scenario, *times = random_scenario(rng, **fixed)
    return LoopMaps(resolve(scenario), *times)


def bounded(resolved: Scenario, guarantee: LossGuarantee | None = None) -> Stability:
    """The certified bounds."""
    return LossMargin(resolved).stability(guarantee, _ACCURACY, decide=False)


def _one_loss_less(loop: LoopMaps) -> Stability:
    guarantee = loop.resolved.network.guarantee
    return bounded(loop.resolved, capped(guarantee, (guarantee.longest_burst or 0) - 1))


def _no_delay(loop: LoopMaps) -> Stability:
    network = loop.resolved.network.model_copy(update={"impairments": ()})
    return bounded(loop.resolved.model_copy(update={"network": network}))


def _soon(loop: LoopMaps) -> Stability:
    shortest_ns, longest_ns = intervals_ns(loop.resolved)
    with patch.object(loss_margin, "intervals_ns", lambda resolved: (shortest_ns, shortest_ns)):
        found = bounded(loop.resolved)
    return found._replace(upper=found.upper ** (longest_ns / shortest_ns), pattern=())


def _each_burst_alone(loop: LoopMaps) -> Stability:
    true = loss_margin.joint_spectral_radius

    def wrong(edges: Sequence[Edge], **options: Any) -> JointSpectralRadius:
        fastest = find_cycle(SwitchedSystem(tuple(edges)), 1, len(edges)).growth
        return true(edges, **options)._replace(upper=fastest)

    with patch.object(loss_margin, "joint_spectral_radius", wrong):
        return bounded(loop.resolved)


def simulate(case: Case, rng: np.random.Generator) -> Observed:
    """Find patterns, and repeat the one of the certificate."""
    loop, found = case.loop, case.found
    runs, *worst = worst_pattern(loop, rng)
    shares = {"growth": loop.growth_limits(*worst)[0] / found.upper, "pattern": 0.0}
    if found.pattern:
        shares["pattern"] = found.lower / loop.growth_of(found)
    return Observed(runs, shares)


def _bounds(certify: Callable[[LoopMaps], Stability]) -> Callable[[Case], Bounds | None]:
    return shares_of(("growth", "pattern"), lambda case: certify(case.loop))


MARGINS = Kind(
    "margin", drawn(random_loop, {}), _bounds(lambda loop: bounded(loop.resolved)), simulate,
    {
        mistake: Broken(_bounds(certify), drawn(random_loop, where))
        for mistake, certify, where in (
            ("one loss less", _one_loss_less, {"mansd": 2, "window": (1, 1)}),
            ("no delay", _no_delay, {"delayed": 0.99}),
            ("each burst alone, repeated", _each_burst_alone, {"mansd": 2, "window": (1, 1), "recovery": 0}),
            ("events are the shortest time apart", _soon, {"periodic": False, "apart": (1, 3)}),
        )
    },
)  # fmt: skip
