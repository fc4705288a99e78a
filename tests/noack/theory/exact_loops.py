"""Random loops in exact continuous time, as in the paper: no sampling, no delay, no held input."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from cosim.simulation.continuous import (
    ContinuousLoop,
    ContinuousRun,
    Samples,
    TooManyEventsError,
    simulate_continuous,
)
from noack.core.linear_systems import Vector
from noack.scenario.resolution import LoopMatrices
from noack.trigger.trigger_rule import Policy
from tests.oracles.lossy_loops import System
from tests.trigger_rules import decaying_rule

_MOST_EVENTS = 3000


class Observed(NamedTuple):
    """A sampled run: at all events just before the reset, and densely in between."""

    run: ContinuousRun
    samples: Samples


def loop_of(system: System) -> LoopMatrices:
    plain = np.array_equal(system.weight, np.eye(len(system.A)))
    names = tuple(f"x_{i}" for i in range(len(system.A)))
    return LoopMatrices(
        A_model=system.H - system.B @ system.K, B_model=system.B, K=system.K, H=system.H,
        A=system.A, B=system.B, x0=system.x0, weight=None if plain else system.weight,
        state_names=names, input_names=names[: len(system.K)],
    )  # fmt: skip


def observe(
    system: System, periods: float, seed: int, samples: int = 200, policy: Policy | None = None
) -> Iterator[Observed]:
    """Runs over some time constants with several loss patterns: the maximum, none, random.

    The policy is the paper's unless another one is given.
    """
    horizon_s = periods / float(np.abs(np.linalg.eigvals(system.A + system.B @ system.K)).max())
    loop = loop_of(system)
    trigger = policy or decaying_rule(system.beta, system.alpha, weight=loop.weight, n=loop.n)
    continuous = ContinuousLoop(loop, trigger)
    rng = np.random.default_rng(seed)
    for share in (1.0, 0.0, 0.6):
        arrives = _pattern(rng.uniform(size=_MOST_EVENTS) < share, system)
        try:
            run = simulate_continuous(
                continuous, horizon_s=horizon_s, delivered=arrives,
                known_start=system.known_start, max_events=_MOST_EVENTS,
            )  # fmt: skip
        except TooManyEventsError:
            continue
        yield Observed(run, _sampled(run, np.linspace(0.0, run.reached_s, samples)))


def _sampled(run: ContinuousRun, t_s: Vector) -> Samples:
    """The signals at the given times and at the events, before their resets."""
    dense, before = run.at(t_s), run.before
    if not before:
        return dense
    return Samples(
        np.concatenate([dense.t_s, [state.t_s for state in before]]),
        *(
            np.concatenate([getattr(dense, name), [getattr(state, name) for state in before]])
            for name in ("x", "e_s", "e_c")
        ),
    )


def _pattern(lost: np.ndarray, system: System) -> list[bool]:
    run, delivered = 0, []
    for event, drop in enumerate(lost):
        drop = drop and run < system.mansd and (system.known_start or event > 0)
        run = run + 1 if drop else 0
        delivered.append(not drop)
    return delivered
