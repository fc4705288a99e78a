"""The worst bounded disturbances and noise for a given pattern of losses.

With given events the loop is linear, so the vector whose norm is largest is the sum of the
responses to each value of a disturbance. Every value is set to its bound, with the sign of its
response in the direction of that vector. The events move then, so the caller runs the loop again.

Only bounds at all times are used: ``uniform`` disturbances and ``noise_bound``. Other kinds stay as
they are drawn.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from cosim.analysis.adversary.objective import Objective
from cosim.analysis.adversary.sampled_flow import SampledFlow
from cosim.analysis.adversary.sampled_run import SampledRun
from cosim.simulation.sampled_loop import (
    Numbers,
    Runs,
    SampledLoop,
    Scales,
    noise_of,
    pushes_of,
    through_of,
)
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix, Vector
from noack.disturbances.uniform import UniformDisturbance

_MOST_RESPONSES = 2000
"""With more values than this, successive ones have the same sign."""


class Bounds(NamedTuple):
    """What the values of disturbances and noise may be."""

    columns: Matrix
    """Change of x by each disturbance at its bound, (n, d)."""
    noise: Vector
    """Bound of each entry of v, (p,)."""


def bounds_of(resolved: Scenario) -> Bounds | None:
    """Return the bounds of a scenario; None if nothing has a bound at all times."""
    through, columns = through_of(resolved), []
    m = resolved.model.dimensions[1]
    for one in resolved.plant.disturbances:
        if isinstance(one, UniformDisturbance):
            at = through[:, :m] if one.at == "input" else through[:, m:]
            columns.append(at @ one.extent())
    noise = np.array(resolved.plant.measurement.noise_bound or ())
    found = np.hstack([np.zeros((len(through), 0)), *columns])
    found = found[:, found.any(axis=0)]
    return Bounds(found, noise) if found.size or noise.any() else None


def worst_causes(
    flow: SampledFlow, bounds: Bounds, run: SampledRun, at_s: float
) -> Iterator[SampledLoop]:
    """Yield loops with the causes that are worst at a time, for the events of a run.

    The norm is largest in some direction: each loop maximises one entry of the vector, with either
    sign, or its part in the direction that it has without the change.
    """
    loop, at = flow.loop, round(at_s / flow.loop.step_s)
    start = loop.start()
    _follow_events(loop, start, start.step.copy(), run, at, 0 if loop.known_start else 1)
    fixed, drawn = _fixed_causes(loop), loop.causes
    n, k, j = loop.matrices.n, at, at // loop.every + 1
    linear = loop.with_causes(np.zeros((0, n)), np.zeros((0, drawn[1].shape[1])))
    pushes = [_responses_to_push(linear, flow, one, run, at) for one in bounds.columns.T]
    noises = [
        _responses_to_noise(linear, flow, entry, bound, run, at)
        for entry, bound in enumerate(bounds.noise)
    ]
    axes = np.eye(n)
    for direction in (_vectors(flow, start)[0], *axes, *-axes):
        push, noise = fixed[0].copy(), fixed[1].copy()
        for column, response in zip(bounds.columns.T, pushes, strict=True):
            push[:k] += np.sign(response @ direction)[:, None] * column
        for entry, response in enumerate(noises):
            noise[:j, entry] += bounds.noise[entry] * np.sign(response @ direction)
        push[k:], noise[j:] = drawn[0][k:], drawn[1][j:]
        yield loop.with_causes(push, noise)


def _responses_to_push(
    linear: SampledLoop, flow: SampledFlow, column: Vector, run: SampledRun, at: int
) -> Matrix:
    """Return what each of the first ``at`` pushes adds to the vector, (at, n)."""
    steps = _some(np.arange(1, at + 1))
    runs = linear.empty(len(steps))
    runs.x[:], runs.step[:] = column, steps
    linear.measure_at(runs)
    _follow_events(linear, runs, steps, run, at, 0)
    return np.repeat(_vectors(flow, runs), np.diff(steps, append=at + 1), axis=0)


def _responses_to_noise(
    linear: SampledLoop, flow: SampledFlow, entry: int, bound: float, run: SampledRun, at: int
) -> Matrix:
    """Return what the noise of each measurement up to ``at`` adds to the vector, (k, n)."""
    last = at // linear.every
    numbers = _some(np.arange(last + 1))
    runs = linear.empty(len(numbers))
    runs.step[:] = numbers * linear.every
    runs.y[:] = bound * linear.correction(numbers)[:, :, entry]
    _follow_events(linear, runs, runs.step.copy(), run, at, 0)
    return np.repeat(_vectors(flow, runs), np.diff(numbers, append=last + 1), axis=0)


def _fixed_causes(loop: SampledLoop) -> tuple[Matrix, Matrix]:
    """Return disturbances and noise without their bounded parts."""
    plant, zeros = loop.resolved.plant, np.zeros_like
    disturbances = tuple(
        one.model_copy(update={"bound": tuple(zeros(one.bound).tolist())})
        if isinstance(one, UniformDisturbance)
        else one
        for one in plant.disturbances
    )
    measurement = plant.measurement
    if measurement.noise_bound is not None:
        silent = tuple(zeros(measurement.noise_bound).tolist())
        measurement = measurement.model_copy(update={"noise_bound": silent})
    changed = {"disturbances": disturbances, "measurement": measurement}
    fixed = loop.resolved.model_copy(update={"plant": plant.model_copy(update=changed)})
    push, noise = pushes_of(fixed), noise_of(fixed)
    return push, noise if len(noise) else np.zeros_like(loop.causes[1])


def _follow_events(
    loop: SampledLoop, runs: Runs, begin: Numbers, run: SampledRun, at: int, first: int
) -> None:
    """Advance runs that begin at ascending steps to the step ``at``, with the events of a run."""
    one = np.ones(loop.last + 1)
    scales = Scales(loop.weight, one, one)
    steps = np.rint(np.array(run.event_s) / loop.step_s).astype(np.int64)
    for event, arrives in list(zip(steps.tolist(), run.delivered, strict=True))[first:]:
        if event >= at:
            break
        count = int(np.searchsorted(begin, event, side="right"))
        parts: list[Any] = [part[:count] for part in runs]
        begun = Runs(*parts)
        loop.follow(begun, scales, np.full(count, event), tests=False)
        loop.update(begun, np.full(count, arrives))
    loop.follow(runs, scales, np.full(len(begin), at), tests=False)


def _vectors(flow: SampledFlow, runs: Runs) -> Matrix:
    """Return the vectors whose norm is the objective, (N, n)."""
    if flow.objective is Objective.STATE:
        return runs.x
    return np.asarray((runs.x_c - runs.y) @ flow.loop.weight.T)


def _some(numbers: Numbers) -> Numbers:
    """Return every k-th number, so that there are not too many responses."""
    return numbers[:: max(len(numbers) // _MOST_RESPONSES, 1)]
