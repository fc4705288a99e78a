"""Exact runs of shipped scenarios from many initial states, in which every update arrives."""

import math

import numpy as np

from cosim.simulation.continuous import ContinuousLoop, continuous_loop_of
from cosim.simulation.exact_simulation import EventLog
from noack.core.linear_systems import Matrix
from tests.helpers.shipped import resolved


def shipped_loop(name: str, *settings: str) -> ContinuousLoop:
    """Return the exact loop of a shipped scenario, with settings as for ``--set``."""
    return continuous_loop_of(resolved(name, *settings))


def states_on_a_circle(count: int) -> Matrix:
    """Return evenly spaced states of length 1; opposite ones have the same runs, so half of them."""
    angles = np.linspace(0.0, math.pi, count, endpoint=False)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def run_from_each(loop: ContinuousLoop, x0: Matrix, horizon_s: float, most_events: int) -> EventLog:
    """Return the events of a run from each initial state; a time of no event is NaN."""
    A, B = (np.broadcast_to(part, (len(x0), *part.shape)) for part in (loop.loop.A, loop.loop.B))
    simulation = loop.simulation(
        horizon_s, known_start=True, delivered=np.zeros(0, np.bool_), most_events=most_events
    )
    rows, log = simulation.runs(A, B, x0, places=most_events, states=True)
    assert not rows["status"].any(), "a run did not reach its end"
    log.event_s[np.arange(most_events) >= rows["transmissions"][:, None]] = np.nan
    return log
