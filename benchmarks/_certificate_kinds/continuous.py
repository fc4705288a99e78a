"""The paper's conditions: continuous time, an instant network, and the bounds from its flow.

The search for bad losses is that of :mod:`benchmarks._certificate_kinds.decaying`.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks._certificate_kinds import Bounds, Broken, Kind, Observed
from benchmarks._certificate_kinds.decaying import bounds_of, search
from noack.theory.certificate import NetworkConditions, VoidError
from noack.theory.enclosure import NotDecayingError
from tests.noack.theory.broken_flow import BROKEN_FLOWS
from tests.noack.theory.continuous_runs import ContinuousTrace, simulate_continuous_time
from tests.noack.theory.loops import System, random_system

_ROUNDED = 1e-12
"""E is computed from rounded matrices; it is not 0 where it should be."""


def _draw(rng: np.random.Generator, **fixed: Any) -> System:
    given = {"sample_steps": 1, "delay_steps": 0, "hold_steps": 0, "known_start": True}
    return random_system(rng, **(given | fixed))


def _conditions(system: System) -> NetworkConditions:
    return NetworkConditions(system.guarantee.longest_burst, constraints=system.guarantee.rules[1:])


def _bounds(system: System) -> Bounds | None:
    try:
        found = system.certify(_conditions(system))
    except (VoidError, NotDecayingError):
        return None
    more = {"x_W": found.state_weighted, "E x": max(found.mismatch, _ROUNDED)}
    return bounds_of(found, system.beta) | more


def _without_one_loss(system: System) -> Bounds | None:
    return _bounds(replace(system, mansd=system.mansd - 1))


def _broken(mistake: Callable[[], AbstractContextManager[Any]], system: System) -> Bounds | None:
    with mistake():
        return _bounds(system)


def _worst(system: System, trace: ContinuousTrace) -> dict[str, float]:
    return {
        "e_s": float(trace.sensor_error.max()),
        "e_c": float(trace.controller_error.max()),
        "x": float(trace.state.max()),
        "x_W": float(trace.state_weighted.max()),
        "u − Kx": float(trace.input_error.max()),
        "E x": float(trace.mismatch.max()),
        "1/δ": 1 / trace.inter_event_s,
    }


def _simulate(system: System, rng: np.random.Generator) -> Observed:
    return search(system, rng, simulate_continuous_time, _worst)


_MISMATCH = partial(_draw, mismatch=0.5, window=(1, 1), recovery=0)

CONTINUOUS = Kind(
    "continuous time", _draw, _bounds, _simulate,
    {"one loss less": Broken(_without_one_loss, partial(_MISMATCH, mansd=1, n=1))}
    | {
        name: Broken(partial(_broken, mistake), partial(_MISMATCH, mansd=3, n=2))
        for name, mistake in BROKEN_FLOWS.items()
    },
)  # fmt: skip
