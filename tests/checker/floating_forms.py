"""The inequalities of a witness in floating point, written anew from the statement, not from the checker.

V = xᵀXx + (e, w)ᵀQ(e, w) − c₁ f₁² − c₂ f₂² − a θ (‖W e‖² − c² f₁² − f² f₂²), for a rule that compares
W e_s, under a schedule. With noise n = Σ column p, |p| ≤ f₂, the last term is
−θ (a ‖W e‖² − a₁ f₁² − a₂ f₂²), and there are inequalities of silent tests. The inputs K e^{−Hs} x_c are
those of random ages, not corners of a hull.
"""

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from noack.proof.elaborate.loop import Loop
from tests.checker.runs import floats

Array = NDArray[np.float64]
_TOLERANCE = 1e-7


class Forms:
    """The forms V of one bound of a loop."""

    def __init__(self, loop: Loop, rate: float, entry: Mapping[str, Any]) -> None:
        self.loop, self.rate, self.numbers, self.matrices = loop, rate, entry["numbers"], entry["matrices"]
        self.decay, self.n = entry["decay"], loop.n
        n = self.n
        every = np.eye(3 * n + 2 + loop.noise.ncols())
        self.x, self.e, self.w = every[:n], every[n : 2 * n], every[2 * n : 3 * n]
        self.f1, self.f2 = every[3 * n : 3 * n + 1], every[3 * n + 1 : 3 * n + 2]
        self.p = every[3 * n + 2 :]
        self.noise = floats(loop.noise) @ self.p
        self.noise_bounds = [row[None].T @ row[None] - self.f2.T @ self.f2 for row in self.p]
        self.W, self.H = floats(loop.weight), floats(loop.H)
        self.times = [float(t.p) / float(t.q) for t in loop.times]
        level, floor = float(loop.rule.level.mid()), float(loop.rule.floor.mid())
        self.threshold = level**2 * self.f1.T @ self.f1 + floor**2 * self.f2.T @ self.f2
        difference = self.W @ (self.e - self.noise)
        self.compared = difference.T @ difference - self.threshold
        self.floor_only = floor**2 * self.f2.T @ self.f2
        self.level_only = level**2 * self.f1.T @ self.f1
        self.exact_level = level > 0 and rate == float(loop.rule.rate.mid())

    def form(self, place: str, node: int) -> Array:
        """Return P of a location, at the start or the end of its time."""
        tested = place.endswith("lost")
        own = place if tested else f"{place}, {node}"
        X = np.array(self.matrices["X" if place != "start, 0 later" else f"X/start, {node}"])
        Q = np.array(self.matrices[f"Q/{own}"])
        errors = np.vstack([self.e, self.w])[: len(Q)]
        P: Array = self.x.T @ X @ self.x + errors.T @ Q @ errors
        for name, f in (("c1", self.f1), ("c2", self.f2)):
            P = P - self.numbers.get(f"{name}/{own}", self.numbers.get(name, 0.0)) * f.T @ f
        if not tested or not node:
            return P
        error = self.W @ self.e
        silent = self.numbers[f"a/{own}"] * (error.T @ error - self.threshold)
        if len(self.p):
            silent = self.numbers[f"a/{own}"] * error.T @ error
            for name, f in (("c1", self.f1), ("c2", self.f2)):
                silent = silent - self.numbers.get(f"a/{own}/{name}", 0.0) * f.T @ f
        return P - self.times[0] * silent

    def flow(self, place: str, age: float) -> tuple[Array, list[tuple[Array, Array]]]:
        """Return F and unknown signals (column, rows) of ż = Fz + column p, |p| ≤ |rows z|."""
        K = floats(self.loop.gain) @ expm(-self.H * age) * (place != "start, 0 later")
        u = K @ (self.x + self.e + self.w)
        moved = floats(self.loop.A) @ self.x + floats(self.loop.B) @ u
        F = np.vstack(
            [
                *(moved, self.H @ (self.x + self.e) - moved, self.H @ self.w),
                *(-self.rate * self.f1, 0 * self.f2, 0 * self.p),
            ]
        )
        unknowns = []
        for half, signal in ((floats(self.loop.half_A), self.x), (floats(self.loop.half_B), u)):
            for i, k in zip(*np.nonzero(half), strict=True):
                root = np.sqrt(half[i, k])
                unknowns.append((root * (self.x - self.e)[[i]].T, root * signal[[k]]))
        pushes = floats(self.loop.pushes)
        for k, size in enumerate(self.loop.sizes):
            root = np.sqrt(float(size.mid()))
            unknowns.append((root * (self.x - self.e).T @ pushes[:, [k]], root * self.f2))
        return F, unknowns

    def holds(self, output: str, rng: np.random.Generator) -> bool:
        """Return whether flows, outputs, edges and the start obey their inequalities."""
        if (
            any(v < 0 for name, v in self.numbers.items() if not name.startswith("c"))
            or self.decay <= 2 * self.rate
        ):
            return False
        losses, (_, _, delay, age, start, *_) = self.loop.losses, self.times
        waits = [("0 later", delay)] if delay else []
        begins = [("start, 0 later", start)] if start else []
        places = [(f"{j} lost", self.times[0]) for j in range(losses + 1)] + waits + begins
        youngest = -self.times[-1]
        ages = [youngest, age, *(youngest + (age - youngest) * rng.random(3))]
        return (
            all(self._flow_holds(*place, node, s) for place in places for node in (0, 1) for s in ages)
            and all(
                self._output_holds(output, name, node, s)
                for name, _ in places
                for node in (0, 1)
                for s in ages
            )
            and self._edges_hold(losses, bool(waits), bool(begins))
            and self._starts("start, 0 later" if begins else "0 lost")
        )

    def _flow_holds(self, place: str, length: float, node: int, age: float) -> bool:
        P, (F, unknowns) = self.form(place, node), self.flow(place, age)
        slope = (self.form(place, 1) - self.form(place, 0)) / length
        M = -(P @ F + F.T @ P + self.decay * P + slope)
        return self._positive(place, M, [-P @ c for c, _ in unknowns], unknowns, f"m/flow/{place}/{node}")

    def _output_holds(self, output: str, place: str, node: int, age: float) -> bool:
        if output == "drift" and place == "start, 0 later":
            return True
        F, unknowns = self.flow(place, age)
        outputs = {"x": self.x, "e_s": self.W @ self.e, "e_c": self.W @ (self.e + self.w)}
        C = outputs.get(output, self.W @ (F[: self.n] - self.H @ self.x))
        columns = [self.W @ c[: self.n] for c, _ in unknowns] if output == "drift" else []
        levels = [self.numbers.get(f"level {k}", 0.0) for k in (1, 2)]
        M = (
            self.form(place, node)
            - C.T @ C
            + levels[0] * self.f1.T @ self.f1
            + levels[1] * self.f2.T @ self.f2
        )
        used = unknowns if output == "drift" else []
        mixed = np.hstack(columns).T @ np.hstack(columns) if columns else np.zeros((0, 0))
        return self._positive(place, M, [-C.T @ c for c in columns], used, f"m/output/{place}/{node}", -mixed)

    def _positive(
        self,
        place: str,
        M: Array,
        sides: list[Array],
        unknowns: list[tuple[Array, Array]],
        name: str,
        corner: Array | None = None,
    ) -> bool:
        """Return whether M with the blocks of unknown signals is positive semidefinite."""
        k = len(unknowns)
        tau = [self.numbers[f"{name}/signal {i}"] for i in range(k)]
        for t, (_, rows) in zip(tau, unknowns, strict=True):
            M = M - t * rows.T @ rows
        side = np.hstack(sides) if sides else np.zeros((len(M), 0))
        below = np.diag(tau) + (corner if corner is not None else 0) if k else np.zeros((0, 0))
        return self._is_psd(place, np.block([[M, side], [side.T, below]]))

    def _is_psd(self, place: str, M: Array) -> bool:
        n = self.n
        has_w = place not in ("0 lost", "start, 0 later")
        kept = [i for i in range(len(M)) if (has_w or not 2 * n <= i < 3 * n) and M[i].any()]
        M = M[np.ix_(kept, kept)]
        scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(M)), 1e-300))
        return len(M) == 0 or bool(np.linalg.eigvalsh(scale[:, None] * M * scale).min() > -_TOLERANCE)

    def _edges_hold(self, losses: int, waits: bool, begins: bool) -> bool:
        arrival, lost, stays = (np.eye(3 * self.n + 2 + len(self.p)) for _ in range(3))
        arrival[2 * self.n : 3 * self.n] = 0
        lost[2 * self.n : 3 * self.n] = self.w + self.e - self.noise
        lost[self.n : 2 * self.n] = self.noise
        found = []
        for j in range(losses + 1):
            to, name, jump = ("0 later", "sent", lost) if waits else ("0 lost", "delivered", arrival @ lost)
            following = [(to, f"{j} lost, {name}", jump)]
            following += [(f"{j + 1} lost", f"{j} lost, lost", lost)] if j < losses else []
            found += [(f"{j} lost", *each, node, 0, True) for each in following for node in (0, 1)]
            if len(self.p):
                found.append((f"{j} lost", f"{j} lost", f"{j} lost, silent", stays, 1, 0, False))
        for place in ["0 later"] * waits + ["start, 0 later"] * begins:
            name = f"{place}, all lost"
            found += [(place, "0 lost", name, arrival, i, j, False) for i in (0, 1) for j in (0, 1)]
        return all(self._edge_holds(*each) for each in found)

    def _edge_holds(
        self, source: str, target: str, name: str, jump: Array, node: int, other: int, event: bool
    ) -> bool:
        M = self.form(source, node) - jump.T @ self.form(target, other) @ jump
        facts = [self.compared, *self.noise_bounds] if name.endswith("silent") else []
        if event and not self.loop.rule.always:
            compared = self.compared + self.threshold
            above_floor = float(self.loop.rule.floor.mid()) > 0 or not self.exact_level
            facts = [self.level_only - compared] * self.exact_level + [
                self.floor_only - compared
            ] * above_floor
        facts += self.noise_bounds if event else []
        for i, fact in enumerate(facts):
            M = M + self.numbers[f"m/edge/{name}/{node} {other}/{i}"] * fact
        return self._is_psd(source, M)

    def _starts(self, place: str) -> bool:
        """Return whether V ≤ 0 at the start for all p; one direction suffices, at its largest V."""
        n, noise = self.n, floats(self.loop.noise)
        z = np.zeros((len(self.x.T), 1 + noise.shape[1]))
        z[:n, 0], z[3 * n : 3 * n + 2, 0] = floats(self.loop.start)[:, 0], 1.0
        z[n : 2 * n, 1:] = noise
        signs = np.array([[1.0, *each] for each in product((-1.0, 1.0), repeat=noise.shape[1])])
        return bool(max(v @ z.T @ self.form(place, 0) @ z @ v for v in signs) <= _TOLERANCE)
