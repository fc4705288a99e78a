"""Whether the state of a run diverged.

A run diverged if its state is not finite, or far above the run's scale and still growing. The scale
is the largest of these values, in units of ‖x‖:

* ‖x‖ in the first tenth of the run,
* the set-points x_r,
* the trigger's initial threshold and its floor, and
* the integral of each later step disturbance over the rest of the run, the largest possible change
  of x.

A run with a finite state diverged if the largest ‖x‖ of its last tenth is more than ``GROWTH``
times that scale and more than twice the largest ‖x‖ of its first seven tenths. An unstable loop
e^{λt} meets this from λT ≈ 7.7 on, where T is the length of the run. In a shorter run, divergence
cannot be distinguished from a transient. A run that is disturbed, saturated or in a limit cycle
does not meet the criterion.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from netem.core.row_operations import all_entries, row_norms
from noack.core.linear_systems import Matrix, Vector
from noack.core.references import Reference
from noack.disturbances.step import StepDisturbance
from noack.scenario.resolution import loop_of, policy_of
from noack.scenario.scenario import Scenario

GROWTH = 1000.0
"""Ratio of ‖x‖ to the expected size beyond which a run diverged."""
_STILL_GROWING = 2.0
"""Factor by which the last tenth must exceed the middle of the run."""
_LEAST_SAMPLES = 20
_REFERENCE_SAMPLES = 1000
"""Shorter records are not judged."""


class Divergence(NamedTuple):
    """The divergence of a run."""

    at_s: float
    """First time at which the state was not finite or exceeded ``GROWTH`` times the scale."""
    text: str
    """Description in one line."""


@np.errstate(all="ignore")
def divergence(
    parts: Iterable[tuple[Vector, Matrix]], count: int, scenarios: Iterable[Scenario]
) -> Divergence | None:
    """Return the divergence of a run; None if the run did not diverge.

    Args:
        parts: times of the samples in s, (k,), ascending, and the plant's state, (k, n).
        count: number of samples in all parts.
        scenarios: the resolved scenario, and the scenarios after each change of settings.
    """
    tenth, seventh, ninth = (round(share * count) for share in (0.1, 0.7, 0.9))
    early = middle = last = highest = 0.0
    peaks: list[tuple[float, float]] = []  # each ‖x‖ above all before, with its time
    samples = 0
    for t_s, x in parts:
        lost = np.flatnonzero(~all_entries(np.isfinite(x)))
        if len(lost):
            at_s = float(t_s[lost[0]])
            return Divergence(at_s, f"diverged: x is not finite at {at_s:g} s")
        norms = row_norms(x)
        early = float(norms[: max(tenth - samples, 0)].max(initial=early))
        middle = float(norms[: max(seventh - samples, 0)].max(initial=middle))
        last = float(norms[max(ninth - samples, 0) :].max(initial=last))
        before = np.maximum.accumulate(np.append(highest, norms))
        above = np.flatnonzero(norms > before[:-1])
        peaks += zip(t_s[above].tolist(), norms[above].tolist(), strict=True)
        highest, samples = float(before[-1]), samples + len(norms)
    if count < _LEAST_SAMPLES:
        return None
    scale = max(early, *map(_scale, scenarios))
    if not scale or last <= max(GROWTH * scale, _STILL_GROWING * middle):
        return None
    at_s = next(t_s for t_s, size in peaks if size > GROWTH * scale)
    return Divergence(
        at_s,
        f"diverged: ‖x‖ passed {GROWTH * scale:.3g} ({GROWTH:g} times its expected size) at "
        f"{at_s:g} s, reached {last:.3g}, and was still growing at the end",
    )


def _scale(scenario: Scenario) -> float:
    """Return the magnitude of ‖x‖ to expect from a scenario's disturbances and reference."""
    loop = loop_of(scenario)
    displacement = 0.0
    for disturbance in scenario.plant.disturbances:
        if isinstance(disturbance, StepDisturbance):
            push = (
                loop.B @ np.array(disturbance.amplitude)
                if disturbance.at == "input"
                else disturbance.amplitude
            )
            until_s = min(disturbance.until_s or scenario.horizon_s, scenario.horizon_s)
            displacement += float(np.linalg.norm(push)) * max(until_s - disturbance.from_s, 0.0)
    reference = largest_reference(loop.reference, scenario)
    threshold = policy_of(scenario).largest_threshold
    if loop.weight is not None:
        threshold /= float(np.linalg.svd(loop.weight, compute_uv=False)[-1])
    return max(displacement, reference, threshold)


def largest_reference(reference: Reference | None, scenario: Scenario) -> float:
    """Return the largest ‖x_r‖ in a resolved scenario, at sampled times."""
    if reference is None:
        return 0.0
    t_ns = np.linspace(0, scenario.timing.horizon_ns, _REFERENCE_SAMPLES).astype(np.int64)
    return float(row_norms(reference.states(t_ns)).max())
