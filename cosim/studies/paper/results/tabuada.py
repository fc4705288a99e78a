"""The relative trigger and its minimum inter-event time (Tabuada, 2007)."""

import numpy as np
from scipy.integrate import quad

from cosim.simulation.continuous import ContinuousLoop
from cosim.studies.paper.published_result import (
    ComparedValue,
    PublishedResult,
    run_from_each,
    shipped_loop,
    unit_states,
)

_SOURCE = "Corollary IV.1"
_METHOD = "shortest inter-event time of exact runs of 2 s; τ is the corollary's integral"
_SIGMAS = (0.02, 0.05, 0.1, 0.2)
"""σ of the triggers ‖e‖ > σ‖x‖ that are simulated."""
_CLOSE = 1.2
"""The shortest time found is at most this multiple of τ."""


def bound_s(loop: ContinuousLoop, sigma: float) -> float:
    """Return τ: φ(τ) = σ, φ̇ = a + (a+b)φ + bφ², φ(0) = 0, a = ‖A+BK‖, b = ‖BK‖."""
    BK = loop.loop.B @ loop.loop.K
    a, b = np.linalg.norm(loop.loop.A + BK, 2), np.linalg.norm(BK, 2)
    bound, _ = quad(lambda phi: 1 / (a + (a + b) * phi + b * phi**2), 0.0, sigma)
    return float(bound)


def _rows() -> list[ComparedValue]:
    rows = []
    for sigma in _SIGMAS:
        trigger = f'trigger={{policy="relative", sigma={sigma}}}'
        loop = shipped_loop("tabuada_dynamic", [trigger])
        log = run_from_each(loop, 10 * unit_states(40, 2), 2.0)
        shortest_s = float(np.nanmin(np.diff(log.event_s, prepend=0.0)))
        least_s = bound_s(loop, sigma)
        agrees = least_s <= shortest_s <= _CLOSE * least_s
        texts = f"{1e3 * least_s:.3f} ms", f"{1e3 * shortest_s:.3f} ms"
        rows.append(ComparedValue(f"shortest interval, σ = {sigma:g}", _SOURCE, "≥", *texts, _METHOD, agrees))
    return rows


RESULT = PublishedResult(
    about="minimum inter-event time of the relative trigger, and how close runs come to it",
    reference="Tabuada, Event-Triggered Real-Time Scheduling of Stabilizing Control Tasks, IEEE "
    "TAC 52(9), 2007; scenario tabuada_dynamic",
    rows=_rows,
    notes=(
        f"agrees: not below τ, and at most {_CLOSE:g} τ, as the bound should not be loose",
        "not available: the paper's text, so its own σ and runs are not compared; the corollary "
        "follows from d(|e|/|x|)/dt ≤ (a + b |e|/|x|)(1 + |e|/|x|)",
    ),
)
