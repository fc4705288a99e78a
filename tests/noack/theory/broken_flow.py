"""Mistakes in the bounds from the flow between two deliveries, each as a context."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

from noack.core.linear_systems import Vector
from noack.theory.bounds.gains import PlantGains
from noack.theory.certificates import delivery_flow, solution
from noack.theory.certificates.delivery_flow import DeliveryFlow, Reach
from noack.theory.certificates.solution import InvariantEllipsoids


def only_the_start() -> AbstractContextManager[Any]:
    """The ellipsoid need not contain what errors drive x to."""

    def within(ellipsoids: InvariantEllipsoids, limit: float) -> Reach | None:
        starts = ellipsoids._starts
        if starts is None:
            return None
        return Reach(starts, float(np.linalg.norm(starts.shape @ ellipsoids.flow.start)), limit)

    return patch.object(InvariantEllipsoids, "within", within)


def no_lost_updates() -> AbstractContextManager[Any]:
    """At an event e_c is 0."""
    return patch.object(solution, "errors_at_events", np.zeros_like)


def no_event_at_the_end() -> AbstractContextManager[Any]:
    """A lost event adds nothing to e_c."""
    exact = solution.errors_after_losses

    def shifted(*given: Any) -> Vector:
        found = exact(*given)
        return np.append(found[:1], found[:-1])

    return patch.object(solution, "errors_after_losses", shifted)


def half_of_the_threshold() -> AbstractContextManager[Any]:
    """Between events ‖e_s‖ stays below half of the threshold."""
    exact = delivery_flow._Stage.largest_error
    return patch.object(
        delivery_flow._Stage,
        "largest_error",
        lambda self, size, added: exact(self, 0.5 * size, added),
    )


def no_drive_of_the_error() -> AbstractContextManager[Any]:
    """After an event e_s stays what H makes of it."""
    return patch.object(
        solution, "error_after", lambda flow, time_s: np.zeros((flow.n, 2 * flow.n))
    )


def no_mismatch() -> AbstractContextManager[Any]:
    """The plant follows its model."""
    exact = DeliveryFlow.__init__

    def without(flow: DeliveryFlow, plant: PlantGains) -> None:
        exact(flow, replace(plant, A=plant.error.H - plant.B @ plant.error.K))

    return patch.object(DeliveryFlow, "__init__", without)


BROKEN_FLOWS: Mapping[str, Callable[[], AbstractContextManager[Any]]] = {
    "the ellipsoid holds x(0) only": only_the_start,
    "no lost updates at an event": no_lost_updates,
    "a lost event adds nothing": no_event_at_the_end,
    "half of the threshold after a lost event": half_of_the_threshold,
    "no drive of e_s": no_drive_of_the_error,
    "no mismatch in the flow": no_mismatch,
}
