"""The paper's conditions: continuous time, an instant network, and the bounds from its flow.

The search for bad losses is that of :mod:`tests.noack.theory.certificates.certificate_kinds.decaying`. The
broken copies are mistakes in the bounds from the flow between two deliveries, each as a context.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from noack.core.linear_systems import Matrix, Vector
from noack.theory.bounds.certificate_terms import Constants, NetworkConditions, NoCertificateError
from noack.theory.bounds.enclosure import KernelBounds, NotDecayingError
from noack.theory.bounds.gains import PlantGains
from noack.theory.certificates.deliveries import sharpened_constants
from noack.theory.certificates.deliveries.delivery_flow import NO_EFFECTS, DeliveryFlow
from noack.theory.certificates.deliveries.delivery_reach import Reach
from noack.theory.certificates.deliveries.inserted_bounds import OpenLoopErrors
from noack.theory.certificates.deliveries.invariant_ellipsoids import InvariantEllipsoids
from noack.theory.certificates.deliveries.sharpened_constants import SharpenedBounds
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certificate_kinds.decaying import (
    bounds_of,
    certified_by,
    dominated_by_errors,
    search,
)
from tests.noack.theory.certificates.certified_loops import certify_loop, guarantee_of
from tests.oracles.continuous_loops import ContinuousTrace, simulate_continuous_time
from tests.oracles.lossy_loops import DRIFTING, System, random_system


def only_the_start() -> AbstractContextManager[Any]:
    """The ellipsoid need not contain what errors drive x to."""

    def reach_within(
        ellipsoids: InvariantEllipsoids, error_bound: float, effects_of: Any = None, _: float = 0.0
    ) -> Reach | None:
        ellipsoid = ellipsoids._best_ellipsoid
        if ellipsoid is None:
            return None
        scale = float(np.linalg.norm(ellipsoid.scaling @ ellipsoids.flow.start))
        effects = NO_EFFECTS if effects_of is None else effects_of(ellipsoid, scale)
        return Reach(ellipsoid, scale, error_bound, effects)

    return patch.object(InvariantEllipsoids, "reach_within", reach_within)


def no_lost_updates() -> AbstractContextManager[Any]:
    """At an event e_c is 0."""
    return patch.object(sharpened_constants, "errors_at_events", np.zeros_like)


def no_mismatch(*, at_nodes: bool) -> AbstractContextManager[Any]:
    """The plant follows its model, at the nodes of the flow, too, or from them on only."""
    exact = DeliveryFlow.__init__

    def without(flow: DeliveryFlow, plant: PlantGains) -> None:
        exact(flow, replace(plant, A=plant.error.H - plant.B @ plant.error.K) if at_nodes else plant)
        flow.generator[flow.n :, : flow.n] = 0.0

    return patch.object(DeliveryFlow, "__init__", without)


def no_age_of_inputs() -> AbstractContextManager[Any]:
    """Inputs that are held and late do not change the flow."""
    return patch.object(SharpenedBounds, "_input_effects", lambda *_: NO_EFFECTS)


def no_lost_errors() -> AbstractContextManager[Any]:
    """In open loop a lost update has left nothing."""
    exact = OpenLoopErrors.bound

    def bound(errors: OpenLoopErrors, *known: Any) -> tuple[Vector, Matrix]:
        between, whole = exact(errors, *known)
        return np.full_like(between, between[0]), np.repeat(whole[:, :1], 2, axis=1)

    return patch.object(OpenLoopErrors, "bound", bound)


def no_time_to_drive() -> AbstractContextManager[Any]:
    """Up to every time inputs have driven x for a moment only."""
    return patch.object(KernelBounds, "integral_until", lambda kernel, ages_s: 0 * ages_s)


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


def _broken(
    certify: Callable[[System], Bounds | None],
    mistake: Callable[[], AbstractContextManager[Any]],
    system: System,
) -> Bounds | None:
    with mistake():
        return certify(system)


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
    }
    | {
        name: Broken(partial(_broken, _bounds, mistake), partial(dominated_by_errors, **where))
        for name, mistake, where in (
            ("the ellipsoid holds x(0) only", only_the_start, {"far": False}),
            ("no lost updates at an event", no_lost_updates, {"far": True}),
            ("no mismatch in the flow", partial(no_mismatch, at_nodes=False), {"far": True, "mansd": 1}),
        )
    },
)  # fmt: skip


_certified = certified_by(certify_loop)


def _sampled(rng: np.random.Generator, far: bool) -> System:
    near = dominated_by_errors(rng, far=far)
    return replace(near, step_s=0.02, delay_steps=1, hold_steps=1, known_start=rng.uniform() < 0.5)


def _scheduled(rng: np.random.Generator) -> System:
    """Few steps in a time constant; half of the loops are like the example, with a schedule."""
    if rng.uniform() < 0.5:
        return _sampled(rng, far=rng.uniform() < 0.5)
    return random_system(rng, n=int(rng.integers(1, 5)))


_LONG = {"mansd": 0, "beta": 0.01, "step_share": 0.03}

SCHEDULED = Kind(
    "schedule", _scheduled, _certified, search,
    {
        name: Broken(partial(_broken, _certified, mistake), draw)
        for name, mistake, draw in (
            ("the ellipsoid holds x(0) only", only_the_start, partial(_sampled, far=False)),
            ("no lost errors in open loop", no_lost_errors, partial(_sampled, far=True)),
            ("inputs drive x for no time", no_time_to_drive, partial(_sampled, far=False)),
            ("no mismatch in the flow", partial(no_mismatch, at_nodes=True),
             partial(random_system, **_LONG, **DRIFTING, delay_steps=4, hold_steps=0)),
            ("no age of inputs in the flow", no_age_of_inputs,
             partial(random_system, **_LONG, n=1, m=1, delay_steps=0, hold_steps=4)),
        )
    },
)  # fmt: skip
