"""Random loops, played step by step: no pattern that is allowed contradicts what is proven."""

from itertools import product

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_are

from cosim.cli.options import find_scenario
from netem.guarantee.loss_guarantee import LossHistory
from noack.core.linear_systems import Matrix
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load, validate
from noack.theory.witnesses.loss_margin import LossMargin

STEP_MS = 20
ROUNDS, RUNS, LONGEST = 5, 40, 6


class Played:
    """A loop in steps of 1 ms: the plant replaces its input every 20 ms; the controller ticks as often."""

    def __init__(
        self, A: Matrix, B: Matrix, K: Matrix, *, holds: bool, period_ms: int, delay_ms: int, phase_ms: int
    ) -> None:
        self.K, self.times = K, (period_ms, delay_ms, phase_ms)
        n, m = B.shape
        plant = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * 1e-3)
        self.plant, self.model = plant[:n], np.eye(n) if holds else expm((A + B @ K) * 1e-3)

    def growth(self, pattern: tuple[bool, ...]) -> float:
        """Return the growth per period under a pattern that is repeated: of the map of a round.

        Many runs are played at once, the columns; their states at the begin of two rounds give the map.
        """
        m, n = self.K.shape
        period, delay, phase = self.times
        rng = np.random.default_rng(0)
        x, model, u = (rng.normal(size=(size, RUNS)) for size in (n, n, m))
        w = u
        on_way: list[tuple[int, Matrix]] = []
        rounds = list[Matrix]()
        for t in range(period * len(pattern) * ROUNDS + 1):
            if t % STEP_MS == 0:
                u = w
            if t % (period * len(pattern)) == 0:
                rounds.append(np.concatenate([x, model, u, *(sent for _, sent in on_way)]))
            if t % period == 0 and pattern[t // period % len(pattern)]:
                on_way.append((t + delay, x))
            while on_way and on_way[0][0] == t:
                model = np.linalg.matrix_power(self.model, delay) @ on_way.pop(0)[1]
            if t % STEP_MS == phase:
                w = self.K @ model
            x, model = self.plant @ np.concatenate([x, u]), self.model @ model
        around = rounds[-1] @ np.linalg.pinv(rounds[-2], rcond=1e-9)
        return float(np.abs(np.linalg.eigvals(around)).max() ** (1 / len(pattern)))


@pytest.mark.parametrize("seed", range(8))
def test_no_played_pattern_grows_faster_than_is_proven(seed: int) -> None:
    rng = np.random.default_rng([seed, 43])
    n, m = 1 + seed % 4, int(rng.integers(1, 3))
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    K = -B.T @ solve_continuous_are(A, B, np.eye(n), np.eye(m))
    holds, period_ms = bool(seed % 2), STEP_MS * int(rng.integers(4, 21))
    delay_ms = int(rng.choice([0, 7, 33, period_ms + 33]))
    phase_ms = 10
    content = load(find_scenario("double_integrator")).model_dump(mode="json", exclude_none=True)
    del content["outputs"]
    content |= {
        "mode": "zoh" if holds else "model",
        "model": {"A": A.tolist(), "B": B.tolist(), "gain": K.tolist()},
        "plant": {"initial_state": [1.0] * n, "rate_hz": 1000 / STEP_MS},
        "controller": {"rate_hz": 1000 / STEP_MS, "phase": phase_ms / STEP_MS},
        "trigger": {"policy": "periodic", "period_s": period_ms / 1000},
        "certificate": {"late_periods": 0},
    }
    content["network"]["impairments"] = [{"kind": "delay", "delay_s": delay_ms / 1000}] * (delay_ms > 0)
    content["network"]["mansd"] = 1 + seed % 3
    margin = LossMargin(resolve(validate(content, f"loop {seed}")))
    stability = margin.stability()
    played = Played(A, B, K, holds=holds, period_ms=period_ms, delay_ms=delay_ms, phase_ms=phase_ms)
    fastest = 0.0
    for length in range(1, LONGEST + 1):
        for pattern in product((True, False), repeat=length):
            history = LossHistory(margin.guarantee.rules)
            if not pattern[0] or any(history.add(not fate) for fate in pattern * LONGEST):
                continue
            fastest = max(fastest, played.growth(pattern))
    tolerance = 1e-4  # of the map of a round
    assert fastest <= stability.upper * (1 + tolerance)
    assert stability.lower <= stability.upper
    assert played.growth(stability.pattern) == pytest.approx(stability.lower, rel=tolerance)
