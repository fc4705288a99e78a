"""Exact runs of shipped scenarios, from which published results are reproduced."""

import math
from collections.abc import Iterable

import numpy as np

from cosim.shipped_files import find_shipped
from cosim.simulation.continuous import ContinuousLoop, continuous_loop_of
from cosim.simulation.exact_simulation import EventLog
from noack.core.errors import MachineError
from noack.core.linear_systems import Matrix
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load


def shipped_loop(name: str, settings: Iterable[str] = ()) -> ContinuousLoop:
    """Return the exact loop of a shipped scenario, with settings as for ``--set``."""
    return continuous_loop_of(resolve(load(find_shipped(name, "scenarios"), list(settings))))


def unit_states(draws: int, n: int) -> Matrix:
    """Return initial states of length 1: evenly spaced for two states, else random, (draws, n)."""
    if n == 2:
        angles = np.linspace(0.0, math.pi, draws, endpoint=False)
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    states = np.random.default_rng(1).normal(size=(draws, n))
    return np.asarray(states / np.linalg.norm(states, axis=1, keepdims=True), np.float64)


def run_from_each(loop: ContinuousLoop, x0: Matrix, horizon_s: float, most_events: int = 2000) -> EventLog:
    """Return the events of a run from each initial state; every update arrives.

    Raise MachineError if a run has more events than ``most_events``.
    """
    k = len(x0)
    A, B = (np.broadcast_to(part, (k, *part.shape)) for part in (loop.loop.A, loop.loop.B))
    simulation = loop.simulation(
        horizon_s, known_start=True, delivered=np.zeros(0, np.bool_), most_events=most_events
    )
    rows, log = simulation.runs(A, B, x0, places=most_events, states=True)
    if rows["status"].any():
        raise MachineError(f"a run did not reach its end within {most_events} events")
    log.event_s[np.arange(most_events) >= rows["transmissions"][:, None]] = np.nan
    return log
