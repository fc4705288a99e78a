"""The paper's conditions: continuous time and an instant network.

The search for bad losses is that of :mod:`tests.noack.theory.certificates.certificate_kinds.decaying`.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from noack.theory.bounds.certificate_terms import Constants, NetworkConditions, NoCertificateError
from noack.theory.bounds.enclosure import NotDecayingError
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certificate_kinds.decaying import bounds_of, search
from tests.noack.theory.certificates.certified_loops import certify_loop, guarantee_of
from tests.oracles.continuous_loops import ContinuousTrace, simulate_continuous_time
from tests.oracles.lossy_loops import DRIFTING, System, random_system

_ROUNDED = 1e-12
"""E is computed from rounded matrices; it is not 0 where it should be."""


def _draw(rng: np.random.Generator, **fixed: Any) -> System:
    given = {"sample_steps": 1, "delay_steps": 0, "hold_steps": 0, "known_start": True}
    return random_system(rng, **(given | fixed))


def _conditions(system: System) -> NetworkConditions:
    return NetworkConditions(guarantee_of(system).longest_burst, constraints=guarantee_of(system).rules[1:])


def constants_of(constants: Constants, beta: float) -> Bounds:
    """The constants that are compared."""
    more = {"x_W": constants.state_weighted, "E x": max(constants.mismatch, _ROUNDED)}
    return bounds_of(constants, beta) | more


def _bounds(system: System) -> Bounds | None:
    try:
        return constants_of(certify_loop(system, _conditions(system)), system.beta)
    except (NoCertificateError, NotDecayingError):
        return None


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


CONTINUOUS = Kind(
    "continuous time", _draw, _bounds, _simulate,
    {
        "one loss less": Broken(
            lambda system: _bounds(replace(system, mansd=system.mansd - 1)),
            partial(_draw, mansd=1, **DRIFTING),
        )
    },
)  # fmt: skip
