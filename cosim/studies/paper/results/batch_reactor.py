"""The batch reactor under periodic event-triggered control: the traffic model of ETCetera."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from cosim.simulation.continuous import ContinuousLoop
from cosim.studies.paper.published_result import (
    ComparedValue,
    PublishedResult,
    run_from_each,
    shipped_loop,
    stored_matrices,
    unit_states,
)
from noack.core.linear_systems import Matrix

_PERIOD_S = 0.01
"""Between two tests of the trigger."""
_SOURCE = "ETCetera's README.md"
_METHOD = "exact runs from random states, and from the four states that wait longest"
_INTERVALS, _AFTER_ONE = {1, 2, 3, 4, 5}, {1, 2, 3}
"""Published times between two events, in periods: all of them, and those that may follow one of 1 period."""


def _periods(loop: ContinuousLoop, states: Matrix) -> NDArray[np.int64]:
    """Return the periods until the first event from each state, (k,)."""
    log = run_from_each(loop, states, 0.2, most_events=30)
    return np.asarray(np.rint(log.event_s[:, 0] / _PERIOD_S), np.int64)


def _held_map(loop: ContinuousLoop, periods: int) -> Matrix:
    """Return M of x(t) = M x(0), at the time t that is ``periods`` after an event."""
    A, BK = loop.loop.A, loop.loop.B @ loop.loop.K
    transition = expm(np.block([[A, BK], [np.zeros((4, 8))]]) * _PERIOD_S * periods)
    return np.asarray(transition[:4, :4] + transition[:4, 4:])


def _slowest_state(loop: ContinuousLoop, periods: int) -> tuple[float, Matrix]:
    """Return the smallest eigenvalue of the compared form after ``periods``, and its state.

    If it is positive, every state has transmitted by then.
    """
    P, N = loop.trigger.form
    z = np.vstack([M := _held_map(loop, periods), np.eye(4) - M])
    values, vectors = np.linalg.eigh(z.T @ (P.T @ P - N.T @ N) @ z)
    return float(values[0]), vectors[:, 0]


def _rows() -> list[ComparedValue]:
    loop = shipped_loop("reactor_petc")
    states = np.vstack([unit_states(2000, 4), *(_slowest_state(loop, k)[1] for k in range(1, 5))])
    periods = _periods(loop, states)
    occurring = set(periods.tolist())
    complete = occurring == _INTERVALS and _slowest_state(loop, 5)[0] > 0
    following = set(_periods(loop, states[periods == 1] @ _held_map(loop, 1).T).tolist())
    forms = stored_matrices("batch_reactor")["region_2"].values()
    stays, leaves = (np.einsum("ki,ij,kj->k", states, form, states) for form in forms)
    in_region, waits_two = (stays <= 0) & (leaves > 0), periods == 2
    counts, agree = (f"{in_region.sum()}", f"{waits_two.sum()}"), bool((in_region == waits_two).all())
    are_listed, after_one = following <= _AFTER_ONE, (_listed(_AFTER_ONE), _listed(following))
    return [
        ComparedValue(
            "intervals, periods", _SOURCE, "=", _listed(_INTERVALS), _listed(occurring), _METHOD, complete
        ),
        ComparedValue("intervals after one of 1 period", _SOURCE, "among", *after_one, _METHOD, are_listed),
        ComparedValue("states whose interval is 2 periods", _SOURCE, "=", *counts, _METHOD, agree),
    ]


def _listed(numbers: set[int]) -> str:
    return ", ".join(map(str, sorted(numbers)))


RESULT = PublishedResult(
    about="inter-event times of periodic event-triggered control on the batch reactor",
    reference="ETCetera (github.com/sync-lab/ETCetera), the example of its documentation; scenario "
    "reactor_petc",
    rows=_rows,
    notes=(
        "intervals: the same five numbers occur; no state waits longer, as after 5 periods the "
        "trigger's condition holds for every state",
        "intervals after one of 1 period: ETCetera computes a set that may be too large, so fewer may occur",
        "states whose interval is 2 periods: of the states of the runs, the published inequalities "
        "hold for as many as wait 2 periods, and they are the same states",
    ),
)
