"""The data of a batch in compiled code: arrays that all runs share, arrays by run, and scratch."""

from typing import Any, NamedTuple

from cosim.simulation.batch.batch_rule import Rule
from cosim.simulation.batch.taylor import Array
from cosim.simulation.batch.vector_lanes import Width


class BatchSystem(NamedTuple):
    """The data that all runs share; matrices in column-major order."""

    H: Array
    K: Array
    weight: Array
    """W; empty: the identity."""
    Q: Array
    """Empty: the identity."""
    R: Array
    """Empty: the identity."""
    inverse: Array
    """1/k at index k."""
    H_k: Array
    """Table of H^k/k!."""
    rule: Rule
    fading_per_s: float
    """α of the supremum of ‖W e_c‖ e^{αt}."""
    horizon_s: float
    known_start: bool
    first_delivered: bool
    settle: float
    most_events: int


class Draws(NamedTuple):
    """The data that differ between the runs; matrices in column-major order, run by run."""

    A: Array
    B: Array
    x0: Array
    keys: Any
    """Keys of the random streams, (runs, stages, 2)."""


class BatchMemory(NamedTuple):
    """Scratch, written before it is read."""

    E: Array
    A_k: Array
    X_k: Array
    reach_s: Array
    """Time over which a polynomial is accurate, by degree."""
    measured_s: Array
    """The same, at the accuracy of the measures."""
    x_c: Array
    """Coefficients, as in all arrays below."""
    e_c: Array
    d: Array
    x: Array
    u: Array
    error: Array
    """W e_s."""
    weighted: Array
    """W e_c."""
    x_scaled: Array
    u_scaled: Array
    squares: Array
    """Coefficients of ‖W e_c‖²."""
    sizes: Array


class LossTable(NamedTuple):
    """The link: the core decides for it."""

    link: int
    """Address of a ``noack_link`` with one flow."""
    decisions: Any
    """(1,) of ``noack_decision``, a buffer."""


class EventLog(NamedTuple):
    """The events of all runs: a row per run, up to the length of the rows."""

    event_s: Any
    delivered: Any


class Batch(NamedTuple):
    """All data of a batch."""

    n: Width
    """Tuple of n entries, n the number of states."""
    m: Width
    """Tuple of m entries, m the number of inputs."""
    system: BatchSystem
    draws: Draws
    network: LossTable
    space: BatchMemory
    log: EventLog
