"""A plant's picture: static shapes, and their motion as columns of the recording.

:func:`picture_of` chooses it; the other files in this folder have one kind of picture each.

Pictures are two-dimensional: they are the same for every plant of a kind, sharp at every size, and
cheap for a viewer without a graphics processor. A picture has the plant's lengths. Here, +y is up;
in the viewer, +y is down, so that every shape and pose is flipped (:func:`upright`, :func:`poses`).
"""

import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cosim.output.figures.palette import CONTROLLER, PLANT, SENSOR, Colour
from cosim.record.align import Reals
from noack.core.linear_systems import Propagator
from noack.scenario.resolution import LoopMatrices, loop_of
from noack.scenario.scenario import Scenario

TIMELINE = "t"
PICTURE = "picture"
"""Parent of all entities of a picture."""
WHO: Mapping[str, Colour] = {"plant": PLANT, "sensor": SENSOR, "controller": CONTROLLER}
"""The bodies of a picture and their colours: the state of the plant, and of the two models."""
_NAMES = {"plant": "x plant", "sensor": "x_s sensor model", "controller": "x_c controller model"}
_ORDERS = {"plant": 2.0, "sensor": 4.0, "controller": 3.0}
STILL: Colour = (128, 132, 138)
"""Colour of static shapes: roads, rails, axes."""

TRAIL_S = 3.0
"""Simulated time for which a trail is visible."""
_FAR = 1e4
"""A coordinate that is never visible."""
_FRONT = 10.0
"""Order of texts, which are in front of all shapes."""
_SAMPLES = 400
"""Times at which the closed loop is computed for its reach."""
_REACH_MARGIN = 1.25

Columns = rr.ComponentColumnList
Shape = rr.LineStrips2D | rr.Points2D | rr.Boxes2D


class Frames(NamedTuple):
    """States at k times; n states, m inputs, N states of the system itself."""

    t_s: Reals
    """(k,) ascending."""
    x: Reals
    """(k, n) state of the plant."""
    x_s: Reals
    """(k, n) state of the sensor's model."""
    x_c: Reals
    """(k, n) state of the controller's model; NaN if it was not recorded."""
    z: Reals | None = None
    """(k, N) internal state of a nonlinear plant; NaN if it was not recorded."""

    def at(self, subset: NDArray[np.bool_]) -> "Frames":
        """Return a subset."""
        return Frames(*(None if part is None else part[subset] for part in self))  # type: ignore[arg-type]

    def of(self, who: str) -> Reals:
        """Return the state (k, n) of one of ``WHO``, in the loop's coordinates."""
        return {"plant": self.x, "sensor": self.x_s, "controller": self.x_c}[who]


def concatenate_frames(batches: Sequence[Frames]) -> Frames:
    """Return successive batches of frames as one batch."""
    t_s, x, x_s, x_c = map(np.concatenate, list(zip(*batches, strict=True))[:4])
    own = [frames.z for frames in batches if frames.z is not None]
    return Frames(t_s, x, x_s, x_c, np.concatenate(own) if own else None)


class DrawnPlant(NamedTuple):
    """A plant that is to be drawn."""

    scenario: Scenario
    """The resolved scenario."""
    loop: LoopMatrices
    reach: Reals
    """(n,) expected maximum of each |x_i|, above 0."""

    def places(self, *names: str) -> tuple[int, ...]:
        """Return the indices in x of the named states; empty if one of them does not exist."""
        states = self.loop.state_names
        return tuple(map(states.index, names)) if set(names) <= set(states) else ()


class Picture(ABC):
    """One plant's picture; entities are named below ``PICTURE``."""

    kinds: tuple[str, ...] = ()
    """Plant kinds that it draws; others may have states with the names that it draws."""
    draws_any = False
    """Whether it draws any plant, if no other picture does."""
    title: str
    """Title of its panel."""
    rate_hz = 60.0
    """Frames per second of simulated time."""
    trails: tuple[str, ...] = ()
    """Entities for which the last ``TRAIL_S`` are visible, not only the newest row."""

    @classmethod
    @abstractmethod
    def of(cls, plant: DrawnPlant) -> "Picture | None":
        """Return the picture of a plant; None if this class does not draw such plants."""

    @abstractmethod
    def bounds(self) -> tuple[float, float, float, float]:
        """Return the visible area: left, right, bottom, top."""

    @abstractmethod
    def scenery(self) -> Mapping[str, Shape]:
        """Return the static shapes, by entity; each is recorded once."""

    @abstractmethod
    def frames(self, frames: Frames) -> Mapping[str, Columns]:
        """Return the motion of the shapes: columns of k rows, by entity."""


def panel(picture: Picture) -> rrb.Spatial2DView:
    """Return the view of a picture."""
    left, right, bottom, top = picture.bounds()
    past = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.Spatial2DView(
        origin=PICTURE,
        name=picture.title,
        visual_bounds=rrb.VisualBounds2D(x_range=[left, right], y_range=[-top, -bottom]),
        overrides={f"{PICTURE}/{entity}": rrb.VisibleTimeRanges([past]) for entity in picture.trails},
    )


def upright(points: Sequence[Sequence[float]] | Reals) -> Reals:
    """Return points (..., 2), for which +y is up, in the viewer's coordinates."""
    return np.asarray(points, dtype=np.float64) * (1.0, -1.0)


def lines(
    strips: Sequence[Sequence[Sequence[float]]],
    colour: Colour,
    width: float,
    *,
    order: float = 0.0,
) -> rr.LineStrips2D:
    """Return lines through points, of this ``width``; a higher ``order`` is in front."""
    return rr.LineStrips2D(
        [upright(strip) for strip in strips], radii=width / 2, colors=colour, draw_order=order
    )


def body(who: str, strips: Sequence[Sequence[Sequence[float]]], width: float) -> rr.LineStrips2D:
    """Return lines of one of ``WHO``; the plant is behind its models."""
    return lines(strips, WHO[who], width, order=_ORDERS[who])


def style(colour: Colour, width: float, *, order: float = 0.0) -> rr.LineStrips2D:
    """Return the style of lines that each frame redraws (:func:`strips`)."""
    return rr.LineStrips2D.from_fields(radii=width / 2, colors=colour, draw_order=order)


def trail_style(who: str, width: float) -> rr.LineStrips2D:
    """Return the style of the trail of one of ``WHO``; trails are behind the bodies."""
    return style(WHO[who], width, order=_ORDERS[who] - 2)


def label(text: str, at: tuple[float, float], colour: Colour) -> rr.Points2D:
    """Return a text below a point."""
    return rr.Points2D(
        upright([at]), radii=0.0, colors=colour, labels=text, show_labels=True, draw_order=_FRONT
    )


def legend(left: float, top: float, step: float) -> dict[str, Shape]:
    """Return the legend of the bodies, one below the other, centred on the given place."""
    return {
        f"legend/{who}": label(_NAMES[who], (left, top - i * step), colour)
        for i, (who, colour) in enumerate(WHO.items())
    }


def poses(x: Reals, y: Reals, angle_rad: Reals | None = None) -> Columns:
    """Return transforms to places (k,), with anticlockwise rotations by angles (k,), if given.

    A shape at NaN, or far outside the visible area, is moved to a place that is never visible.
    """
    position = np.nan_to_num(np.column_stack([x, -y, np.zeros_like(x)]), nan=_FAR, posinf=_FAR)
    translation = np.clip(position, -_FAR, _FAR).astype(np.float32)
    if angle_rad is None:
        return rr.Transform3D.columns(translation=translation)
    half = -0.5 * np.nan_to_num(angle_rad, posinf=0.0, neginf=0.0)
    turn = np.zeros((len(x), 4), dtype=np.float32)
    turn[:, 2], turn[:, 3] = np.sin(half), np.cos(half)
    return rr.Transform3D.columns(translation=translation, quaternion=turn)


def strips(points: Reals) -> Columns:
    """Return one line per frame, through points (k, p, 2)."""
    return rr.LineStrips2D.columns(strips=clipped(upright(points)))


def clipped(points: Reals) -> NDArray[np.float32]:
    """Return points in the recording's format; invalid ones get a place that is never visible."""
    return np.clip(np.nan_to_num(points, nan=_FAR), -_FAR, _FAR).astype(np.float32)


def circle(radius: float, corners: int, centre: tuple[float, float] = (0.0, 0.0)) -> list[list[float]]:
    """Return the corners of a regular polygon."""
    around = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    points = np.column_stack([np.cos(around), np.sin(around)])
    return (radius * points + centre).tolist()  # type: ignore[no-any-return]


def outline(corners: Sequence[Sequence[float]], dash: float | None = None) -> list[list[list[float]]]:
    """Return a closed line through corners, or dashes of a given length along it.

    A dashed line can be distinguished from a solid one without colours.
    """
    ends = [*corners, corners[0]]
    if dash is None:
        return [[list(map(float, corner)) for corner in ends]]
    pieces: list[list[list[float]]] = []
    for begin, end in pairwise(ends):
        a, b = np.array(begin, dtype=float), np.array(end, dtype=float)
        count = max(round(float(np.linalg.norm(b - a)) / (2 * dash)), 1)
        for i in range(count):
            at = [(i + part) / count for part in (0.15, 0.65)]
            pieces.append([(a + share * (b - a)).tolist() for share in at])
    return pieces


def picture_of(scenario: Scenario) -> Picture:
    """Return the picture of a resolved scenario's plant: of the first file that draws such plants.

    It is a phase plot if no other one does.
    """
    loop = loop_of(scenario)
    plant = DrawnPlant(scenario, loop, reach_of(loop, scenario.timing.horizon_ns))
    package = __name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(import_module(package).__path__):
        import_module(f"{package}.{module.name}")
    kind = scenario.plant.system.kind
    for drawing in sorted(
        Picture.__subclasses__(), key=lambda each: (each.draws_any, kind not in each.kinds)
    ):
        if (picture := drawing.of(plant)) is not None:
            return picture
    raise AssertionError("the phase plot draws any plant")


def reach_of(loop: LoopMatrices, horizon_ns: int) -> Reals:
    """Return (n,) max |x_i| of the model's closed loop from x(0), plus a margin.

    It is 1 for a state that stays at 0.
    """
    step = Propagator(loop.A_model + loop.B_model @ loop.K).transition(max(horizon_ns // _SAMPLES, 1))
    times_ns = np.linspace(0, horizon_ns, _SAMPLES + 1).astype(np.int64)
    points = np.zeros((_SAMPLES + 1, loop.n)) if loop.reference is None else loop.reference.states(times_ns)
    deviation, reach = loop.x0 - points[0], np.abs(loop.x0)
    with np.errstate(all="ignore"):
        for point in points[1:]:
            deviation = step @ deviation
            reach = np.fmax(reach, np.abs(point + deviation))
    known = np.isfinite(reach) & (reach > 0)
    return np.where(known, _REACH_MARGIN * reach, 1.0)
