"""What the search for patterns needs of a loop: its start, and runs from event to event."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.adversary.objective import Objective
from noack.core.linear_systems import Matrix, Vector

Flags = NDArray[np.bool_]


class Segments(NamedTuple):
    """The ends of N segments: the next event, or the horizon."""

    end_s: Vector
    """(N,)"""
    z: Matrix
    """The runs' states at the end, before the event, (N, entries)."""
    is_event: Flags
    """Whether the segment ends in an event, not at the horizon or by divergence, (N,)."""
    value: Vector
    """The segment's value, (N,); infinite if the loop diverged."""
    at_s: Vector | None = None
    """Where each is reached, (N,), if the flow knows that."""


class PatternFlow(Protocol):
    """A loop whose runs are followed from event to event; a run's state is a row of numbers."""

    @property
    def objective(self) -> Objective:
        """What is maximised."""
        ...

    @property
    def horizon_s(self) -> float:
        """End of the runs."""
        ...

    def start(self) -> Segments:
        """Return the start of all runs: after the first packet, or with x(0) known."""
        ...

    def __call__(self, t_s: Vector, z: Matrix, known: float = -np.inf) -> Segments:
        """Follow N runs from times (N,), just after events, to their next events.

        Results below ``known`` may be inaccurate.
        """
        ...

    def after_events(self, t_s: Vector, z: Matrix, delivered: Flags) -> Matrix:
        """Return the states just after events at times (N,); ``delivered`` updates arrive."""
        ...

    def promise(self, t_s: Vector, z: Matrix, window_s: float) -> Vector:
        """Return how large the objective may become within a window, (N,), on any scale."""
        ...

    def features(self, t_s: Vector, z: Matrix) -> Matrix:
        """Return numbers of size 1 that are nearly equal for runs that nearly coincide, (N, k)."""
        ...
