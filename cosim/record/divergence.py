"""Whether a run diverged: its state is not finite, or it outgrew its scale and still grew.

The scale of a run is the largest, in units of ‖x‖, of

* ‖x‖ in the first tenth of the run,
* the set-points x_r,
* the threshold that the trigger begins with or has as its floor, and
* how far a step disturbance that begins later could carry x: its integral over the rest of the run.

A run whose state stays finite diverged if the largest ‖x‖ of its last tenth is more than
``GROWTH`` times that scale and more than twice the largest of its first seven tenths. An unstable
loop e^{λt} meets this from λT ≈ 7.7 on, T the length of the run. In a shorter run its growth is not
told from a transient; a run that is disturbed, saturated or in a limit cycle does not meet it.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector, row_norms
from noack.disturbances.step import StepDisturbance

GROWTH = 1000.0
_STILL_GROWING = 2.0
_LEAST_SAMPLES = 20


class Divergence(NamedTuple):
    """That a run diverged."""

    at_s: float
    """When its state ceased to be finite, or passed ``GROWTH`` times its scale."""
    text: str
    """In words, one line."""


@np.errstate(all="ignore")
def divergence(t_s: Vector, x: Matrix, scenarios: Iterable[Scenario]) -> Divergence | None:
    """Return that a run diverged; None if it did not.

    Args:
        t_s: times of the samples, (k,), ascending.
        x: the plant's state, (k, n).
        scenarios: the resolved scenario, and those that changes of settings made of it.
    """
    lost = np.flatnonzero(~np.isfinite(x).all(axis=1))
    if len(lost):
        at_s = float(t_s[lost[0]])
        return Divergence(at_s, f"diverged: x is not finite at {at_s:g} s")
    if len(t_s) < _LEAST_SAMPLES:
        return None
    norms = row_norms(x)
    tenth, seventh, ninth = (round(share * len(norms)) for share in (0.1, 0.7, 0.9))
    scale = max(float(norms[:tenth].max()), *map(_scale, scenarios))
    last = float(norms[ninth:].max())
    if not scale or last <= max(GROWTH * scale, _STILL_GROWING * float(norms[:seventh].max())):
        return None
    at_s = float(t_s[np.argmax(norms > GROWTH * scale)])
    return Divergence(
        at_s,
        f"diverged: ‖x‖ passed {GROWTH * scale:.3g} ({GROWTH:g} times its expected size) at "
        f"{at_s:g} s, reached {last:.3g}, and was still growing at the end",
    )


def _scale(scenario: Scenario) -> float:
    """Return the size of ‖x‖ that a scenario lets expect from its disturbances and set-point."""
    loop = loop_of(scenario)
    carried = 0.0
    for one in scenario.plant.disturbances:
        if isinstance(one, StepDisturbance):
            push = loop.B @ np.array(one.amplitude) if one.at == "input" else one.amplitude
            until_s = min(one.until_s or scenario.horizon_s, scenario.horizon_s)
            carried += float(np.linalg.norm(push)) * max(until_s - one.from_s, 0.0)
    setpoint = 0.0 if loop.setpoint is None else float(np.linalg.norm(loop.setpoint))
    threshold = scenario.trigger.largest_threshold
    if loop.weight is not None:
        threshold /= float(np.linalg.svd(loop.weight, compute_uv=False)[-1])
    return max(carried, setpoint, threshold)
