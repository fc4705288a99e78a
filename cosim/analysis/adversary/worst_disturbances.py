"""The worst bounded disturbances and noise for a run whose events and losses are given.

With given events the loop is linear, so the vector whose norm is largest is the sum of the
responses to each value of a disturbance. Every value is set to its bound, with the sign of its
response in the direction of that vector. The events move then, so the caller runs the loop again.
Only bounds at all times are used: ``uniform`` disturbances and ``noise_bound``. Other kinds stay as
they are drawn.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from cosim.analysis.adversary.loop_flows import Objective, SampledFlow, SampledRun
from cosim.simulation.sampled_loop import (
    Numbers,
    Runs,
    SampledLoop,
    Scales,
    disturbance_effect,
    noise_of,
    state_increments,
)
from noack.core.linear_systems import Matrix, Vector
from noack.disturbances.uniform import UniformDisturbance
from noack.scenario.scenario import Scenario

_MOST_RESPONSES = 2000
"""With more values than this, successive ones have the same sign."""


class DisturbanceBounds(NamedTuple):
    """What the values of disturbances and noise may be."""

    columns: Matrix
    """Change of x by each disturbance at its bound, (n, d)."""
    noise: Vector
    """Bound of each entry of v, (p,)."""


def disturbance_bounds(resolved: Scenario) -> DisturbanceBounds | None:
    """Return the bounds of a scenario; None if nothing has a bound at all times."""
    effect, columns = disturbance_effect(resolved), []
    m = resolved.model.dimensions[1]
    for disturbance in resolved.plant.disturbances:
        if isinstance(disturbance, UniformDisturbance):
            entry_matrix = effect[:, :m] if disturbance.at == "input" else effect[:, m:]
            columns.append(entry_matrix @ disturbance.extent())
    noise = np.array(resolved.plant.measurement.noise_bound or ())
    changes = np.hstack([np.zeros((len(effect), 0)), *columns])
    changes = changes[:, changes.any(axis=0)]
    return DisturbanceBounds(changes, noise) if changes.size or noise.any() else None


def worst_disturbances(
    flow: SampledFlow, bounds: DisturbanceBounds, run: SampledRun, at_s: float
) -> Iterator[SampledLoop]:
    """Yield loops whose disturbances and noise are worst at a time, for the events of a run.

    The norm is largest in some direction: each loop maximises one entry of the vector, with either
    sign, or its part in the direction that it has without the change.
    """
    loop, step = flow.loop, round(at_s / flow.loop.step_s)
    start = loop.start()
    _follow_events(loop, start, start.step.copy(), run, step, 0 if loop.known_start else 1)
    fixed, drawn = _fixed_disturbances(loop), loop.disturbances
    n, k, j = loop.matrices.n, step, step // loop.steps_per_measurement + 1
    linear = loop.with_disturbances(np.zeros((0, n)), np.zeros((0, drawn[1].shape[1])))
    responses = [_responses_to_disturbance(linear, flow, column, run, step) for column in bounds.columns.T]
    noises = [
        _responses_to_noise(linear, flow, entry, bound, run, step) for entry, bound in enumerate(bounds.noise)
    ]
    axes = np.eye(n)
    for direction in (_vectors(flow, start)[0], *axes, *-axes):
        disturbed, noise = fixed[0].copy(), fixed[1].copy()
        for column, response in zip(bounds.columns.T, responses, strict=True):
            disturbed[:k] += np.sign(response @ direction)[:, None] * column
        for entry, response in enumerate(noises):
            noise[:j, entry] += bounds.noise[entry] * np.sign(response @ direction)
        disturbed[k:], noise[j:] = drawn[0][k:], drawn[1][j:]
        yield loop.with_disturbances(disturbed, noise)


def _responses_to_disturbance(
    linear: SampledLoop, flow: SampledFlow, column: Vector, run: SampledRun, step: int
) -> Matrix:
    """Return what the disturbance of each step before ``step`` adds to the vector, (step, n)."""
    steps = _some(np.arange(1, step + 1))
    runs = linear.empty(len(steps))
    runs.x[:], runs.step[:] = column, steps
    linear.measure_at(runs)
    _follow_events(linear, runs, steps, run, step, 0)
    return np.repeat(_vectors(flow, runs), np.diff(steps, append=step + 1), axis=0)


def _responses_to_noise(
    linear: SampledLoop, flow: SampledFlow, entry: int, bound: float, run: SampledRun, step: int
) -> Matrix:
    """Return what the noise of each measurement up to ``step`` adds to the vector, (k, n)."""
    last = step // linear.steps_per_measurement
    numbers = _some(np.arange(last + 1))
    runs = linear.empty(len(numbers))
    runs.step[:] = numbers * linear.steps_per_measurement
    runs.y[:] = bound * linear.correction(numbers)[:, :, entry]
    _follow_events(linear, runs, runs.step.copy(), run, step, 0)
    return np.repeat(_vectors(flow, runs), np.diff(numbers, append=last + 1), axis=0)


def _fixed_disturbances(loop: SampledLoop) -> tuple[Matrix, Matrix]:
    """Return disturbances and noise without their bounded parts."""
    plant, zeros = loop.resolved.plant, np.zeros_like
    disturbances = tuple(
        disturbance.model_copy(update={"bound": tuple(zeros(disturbance.bound).tolist())})
        if isinstance(disturbance, UniformDisturbance)
        else disturbance
        for disturbance in plant.disturbances
    )
    measurement = plant.measurement
    if measurement.noise_bound is not None:
        silent = tuple(zeros(measurement.noise_bound).tolist())
        measurement = measurement.model_copy(update={"noise_bound": silent})
    changed = {"disturbances": disturbances, "measurement": measurement}
    fixed = loop.resolved.model_copy(update={"plant": plant.model_copy(update=changed)})
    increments, noise = state_increments(fixed), noise_of(fixed)
    return increments, noise if len(noise) else np.zeros_like(loop.disturbances[1])


def _follow_events(
    loop: SampledLoop, runs: Runs, begin: Numbers, run: SampledRun, last_step: int, first_event: int
) -> None:
    """Advance runs that begin at ascending steps to ``last_step``, with the events of a run."""
    ones = np.ones(loop.last + 1)
    scales = Scales(loop.weight, ones, ones)
    steps = np.rint(np.array(run.event_s) / loop.step_s).astype(np.int64)
    for event, arrives in list(zip(steps.tolist(), run.delivered, strict=True))[first_event:]:
        if event >= last_step:
            break
        count = int(np.searchsorted(begin, event, side="right"))
        parts: list[Any] = [part[:count] for part in runs]
        running = Runs(*parts)
        loop.follow(running, scales, np.full(count, event), tests=False)
        loop.transmit(running, np.full(count, arrives))
    loop.follow(runs, scales, np.full(len(begin), last_step), tests=False)


def _vectors(flow: SampledFlow, runs: Runs) -> Matrix:
    """Return the vectors whose norm is the objective, (N, n)."""
    if flow.objective is Objective.STATE:
        return runs.x
    return np.asarray((runs.x_c - runs.y) @ flow.loop.weight.T)


def _some(numbers: Numbers) -> Numbers:
    """Return every k-th number, so that there are not too many responses."""
    return numbers[:: max(len(numbers) // _MOST_RESPONSES, 1)]
