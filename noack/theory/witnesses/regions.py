"""The search for a region that a plant does not leave, and for the witness of this.

On a larger region a plant's equations are enclosed by more plants, and so have larger bounds. The search
begins with a small region, and takes little more than the bounds that follow from it as the next one, until
a region's bounds are inside it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Vector
from noack.core.progress import Progress, no_progress, part_of
from noack.plants.systems.traced_equations import NotEnclosedError, TracedEquations
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.scenario import read_region
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.documents import (
    RoughBounds,
    Witness,
    find_witness,
    rough_bounds,
    witness_by_gains,
)
from noack.theory.witnesses.effort import MOST_WORK, Effort, NoWitnessError, WorkLimitError

_FIRST = 0.1
"""The first region, in multiples of what decides which coordinates it restricts."""
_WIDER, _MOST_REGIONS = 1.03, 12
_LAST_WIDER, _LAST_TRIES = 1.06, 3
_LEAST = 1e-3
"""Least width of a region in each direction, as a share of its largest."""
_SAME = 1e-5
_TIGHT = 0.8
"""A region whose bounds are all below this share of it is replaced by a smaller one."""
_EXPECTED = 40


class PlantOnRegions(NamedTuple):
    """A loop with a plant's equations, on any region."""

    names: Sequence[str]
    """Of x and u."""
    states: int
    typical: Vector
    """A width of each of x and u, (n + m,): where the equations show by what they are not linear."""
    on: Callable[[Vector], tuple[TracedEquations, Loop]]
    """Return the equations and the loop for widths of x and u; raises NotEnclosedError, RefusedError."""


def find_region_witness(
    plant: PlantOnRegions,
    outputs: Sequence[str] = ("x", "e_c"),
    *,
    ultimate: Sequence[str] = (),
    near: Sequence[Mapping[str, object]] = (),
    progress: Progress = no_progress,
    most_work: float = MOST_WORK,
) -> Witness:
    """Return a witness for bounds of outputs of a plant on a region that it is proven not to leave.

    Args:
        plant: the plant.
        outputs: those that are bounded from the start on.
        ultimate: those that are bounded in the limit t → ∞.
        near: documents of the same plant with other thresholds: the search begins with the region of the
            first one.
        progress: called with the completed share.
        most_work: limit of the search, see :class:`Effort`.

    Raises:
        NoWitnessError: none was found; the message names the region that would be needed.
    """
    effort = Effort(part_of(progress, 0.0, 0.5), most_work)
    effort.expect(_EXPECTED)
    restricted = _restricted(plant)
    coordinates = [_output(plant, k) for k in restricted]
    widths = np.full_like(plant.typical, np.inf)
    if restricted:
        first = _first_region(plant, restricted, near)
        widths, rough = _own_bounds_inside(plant, restricted, first, near, effort)
        near = [*near, rough]
    why: NoWitnessError | None = None
    for _ in range(_LAST_TRIES):
        try:
            return _witness(plant, widths, [*outputs, *coordinates], ultimate, near, progress, most_work)
        except WorkLimitError:
            raise
        except NoWitnessError as error:
            why, widths = error, _LAST_WIDER * widths
    raise NoWitnessError(f"{_described(plant, widths)}: {why}")


def _first_region(
    plant: PlantOnRegions, restricted: Sequence[int], near: Sequence[Mapping[str, object]]
) -> Vector:
    """Return the region with which the search begins: that of a document, or a small one."""
    for document in near:
        if isinstance(table := document.get("region"), Mapping):
            region = read_region({"region": table}, plant.states, len(plant.names) - plant.states)
            limits = [*region.x, *region.u]
            if all(limits[k] is not None for k in restricted):
                return _with(plant, restricted, np.array([float(limits[k] or 0.0) for k in restricted]))
    return _with(plant, restricted, _FIRST * plant.typical[restricted])


def _own_bounds_inside(
    plant: PlantOnRegions,
    restricted: Sequence[int],
    widths: Vector,
    near: Sequence[Mapping[str, object]],
    effort: Effort,
) -> tuple[Vector, Mapping[str, object]]:
    """Return a region that contains the rough bounds that follow from it, and their document.

    Raises:
        NoWitnessError: none is found; the message names the region that the bounds from x(0) need.
    """
    coordinates = [_output(plant, k) for k in restricted]
    reached = np.zeros(len(restricted))
    for attempt in range(_MOST_REGIONS):
        try:
            last, rough = reached, _rough_bounds(plant, widths, coordinates, near, effort)
        except WorkLimitError:
            raise
        except NoWitnessError as error:
            if not attempt:
                raise
            raise NoWitnessError(
                f"the bounds from x(0) need a larger region than there is: {error}"
            ) from None
        reached, near = np.array(rough.sizes), [rough.document]
        if (reached < widths[restricted]).all():
            if (reached > _TIGHT * widths[restricted]).any():
                return widths, rough.document
            widths = _with(plant, restricted, _WIDER * reached)  # inside it the bounds are not larger
            continue
        grown = _WIDER * _extrapolated(last, reached, widths[restricted])
        widths = _with(plant, restricted, np.maximum(grown, _LEAST * grown.max()))
    raise NoWitnessError(f"{_described(plant, widths)}: the bounds are not within it, as on the smaller ones")


def _witness(
    plant: PlantOnRegions,
    widths: Vector,
    outputs: Sequence[str],
    ultimate: Sequence[str],
    near: Sequence[Mapping[str, object]],
    progress: Progress,
    most_work: float,
) -> Witness:
    equations, loop = _on(plant, widths)
    found = find_witness(
        loop,
        outputs,
        ultimate=ultimate,
        near=near,
        progress=part_of(progress, 0.5, 1.0),
        most_work=most_work,
    )
    region = region_table(widths, plant.states)
    return found._replace(document={**found.document, "equations": equations.document, "region": region})


def is_enclosed_everywhere(plant: PlantOnRegions) -> bool:
    """Return whether the equations have an enclosure for all x and u."""
    try:
        plant.on(np.full_like(plant.typical, np.inf))
    except NotEnclosedError:
        return False
    return True


def region_witness_by_gains(plant: PlantOnRegions, outputs: Sequence[str]) -> Witness:
    """Return a witness by gains of equations that are enclosed for all x and u, without a search.

    Raises:
        NoWitnessError: they are not, or nothing is proven by gains.
    """
    widths = np.full_like(plant.typical, np.inf)
    equations, loop = _on(plant, widths)
    found, region = witness_by_gains(loop, outputs), region_table(widths, plant.states)
    return found._replace(document={**found.document, "equations": equations.document, "region": region})


def region_table(widths: Vector, states: int) -> Mapping[str, object]:
    """Return a region as a document has it; infinite widths are None."""
    limits = [None if np.isinf(width) else float(width) for width in widths]
    return {"x": limits[:states], "u": limits[states:]}


def _rough_bounds(
    plant: PlantOnRegions,
    widths: Vector,
    outputs: Sequence[str],
    near: Sequence[Mapping[str, object]],
    effort: Effort,
) -> RoughBounds:
    """Return bounds of x and u, where they have to be in a region, by the plants that enclose it there."""
    _, loop = _on(plant, widths)
    try:
        return rough_bounds(loop, outputs, near, effort)
    except WorkLimitError:
        raise
    except NoWitnessError as error:
        raise NoWitnessError(f"{_described(plant, widths)}: {error}") from None


def _on(plant: PlantOnRegions, widths: Vector) -> tuple[TracedEquations, Loop]:
    try:
        return plant.on(widths)
    except NotEnclosedError as error:
        raise NoWitnessError(f"{_described(plant, widths)}: {error}") from None


def _restricted(plant: PlantOnRegions) -> list[int]:
    """Return the coordinates whose size the enclosure of the equations depends on."""
    widths, found = plant.typical.copy(), []
    while True:  # the equations may not be defined on all of the typical region
        try:
            best = _entries(plant, widths)
            break
        except NotEnclosedError as error:
            if widths.max() < _FIRST * plant.typical.max():
                raise NoWitnessError(str(error)) from None
            widths = widths / 2
    for k in range(len(widths)):
        wider = widths.copy()
        wider[k] = np.inf
        try:
            is_same = np.abs(_entries(plant, wider) - best).max() <= _SAME * np.abs(best).max()
        except NotEnclosedError:
            is_same = False
        if is_same:
            widths = wider
        else:
            found.append(k)
    return found


def _entries(plant: PlantOnRegions, widths: Vector) -> Vector:
    """Return matrices, half-widths and sizes of disturbances of the plants that enclose the equations."""
    plants = plant.on(widths)[0].plants
    sizes = np.sqrt((floats(plants.pushes) ** 2).sum(axis=1))
    matrices = plants.A, plants.B, plants.half_A, plants.half_B
    return np.concatenate([*(floats(M).ravel() for M in matrices), sizes])


def _with(plant: PlantOnRegions, restricted: Sequence[int], sizes: Vector) -> Vector:
    widths = np.full(len(plant.typical), np.inf)
    widths[restricted] = sizes
    return widths


def _extrapolated(last: Vector, reached: Vector, widths: Vector) -> Vector:
    """Return where the bounds tend to if they go on to grow by the same factor from region to region."""
    steps, before = reached - widths, widths - last
    ratio = float(np.linalg.norm(steps)) / max(float(np.linalg.norm(before)), 1e-300)
    if last.any() and ratio < 0.7:
        return np.maximum(reached, reached + steps * ratio / (1 - ratio))
    return reached


def _output(plant: PlantOnRegions, k: int) -> str:
    return f"x[{k}]" if k < plant.states else f"u[{k - plant.states}]"


def _described(plant: PlantOnRegions, widths: Vector) -> str:
    pairs = zip(plant.names, widths, strict=True)
    limits = [f"|{name}| ≤ {width:.3g}" for name, width in pairs if np.isfinite(width)]
    return f"on the region {', '.join(limits)}" if limits else "for all x and u"
