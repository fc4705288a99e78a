"""The growth of the worst loss pattern: width of its bracket and time, for M = 8.

The alternative is the simplest rigorous upper bound, the largest norm of all products of three
bursts, in the same balanced coordinates.
"""

import argparse
import time
from itertools import product

import numpy as np
from scipy.signal import place_poles

from benchmarks._report import Benchmark, Goal, Peer, Row, say
from cosim.cli import find_scenario
from noack.config.resolution import resolve
from noack.config.scenario_file import load
from noack.impairments.loss_guarantee import LongestBurst, LossGuarantee
from noack.theory.joint_spectral_radius import joint_spectral_radius
from noack.theory.loss_margin import LossMargin, bursts_of
from noack.theory.switched_system import Edge, SwitchedSystem
from noack.theory.time_triggered_loop import LoopTimes, TimeTriggeredLoop

_M = 8
_RANDOM = 8


def random_loop(seed: int) -> TimeTriggeredLoop:
    """An unstable plant of 2 to 5 states, 6 with the inputs, with its poles placed and held."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 6))
    m = min(6 - n, n)
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    A += (0.3 - np.linalg.eigvals(A).real.max()) * np.eye(n)
    K = -place_poles(A, B, -1 - 2 * rng.random(n)).gain_matrix
    H = A + 0.05 * rng.normal(size=(n, n)) + B @ K if seed % 2 else np.zeros((n, n))
    period_ns = int(rng.integers(10, 150)) * 2_000_000
    return TimeTriggeredLoop(A, B, K, H, LoopTimes(2_000_000, 2_000_000, 1_000_000, period_ns, 0))


def bracket(loop: TimeTriggeredLoop) -> tuple[float, float, float]:
    """Return upper/lower − 1, that of the alternative, and the time in seconds."""
    begun_s = time.perf_counter()
    bursts = bursts_of(LossGuarantee((LongestBurst(_M - 1),)))
    edges = [Edge(0, 0, loop.map(0, one.losses), one.losses + 1) for one in bursts]
    found = joint_spectral_radius(edges)
    took_s = time.perf_counter() - begun_s
    balanced = SwitchedSystem(tuple(edges)).balanced()
    norms = [
        np.linalg.norm(balanced.product(path).middle, 2) ** (1 / balanced.duration(path))
        for path in product(range(_M), repeat=3)
    ]
    return found.upper / found.lower - 1, max(norms) / found.lower - 1, took_s


def measure(options: argparse.Namespace) -> list[Row]:
    """Measure the example and random loops."""
    say("lane_periodic")
    lane = LossMargin(resolve(load(find_scenario("lane_periodic"), ()))).loop
    rows, found = [], {"lane_periodic": [bracket(lane)], "random loops, widest": []}
    for seed in range(_RANDOM):
        say(f"random loop {seed}")
        found["random loops, widest"].append(bracket(random_loop(seed)))
    for name, brackets in found.items():
        widest, norms, took_s = (max(values) for values in zip(*brackets, strict=True))
        peer = Peer("largest norm of three bursts", norms)
        rows.append(Row(f"{name}: bracket of the growth, M = {_M}, relative", widest, "", peer))
        rows.append(Row(f"{name}: longest time", took_s, "s", goal=Goal("<=", 60)))
    return rows


BENCHMARK = Benchmark("loss_margins", "Growth of the worst loss pattern", measure)
