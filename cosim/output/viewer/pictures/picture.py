"""What a picture of the plant is: still shapes, and what moves them, as columns for the recording.

Pictures are drawn in two dimensions: they are the same for every plant of a kind, sharp at every
size, and cost a viewer without a graphics processor little. A picture's lengths are those of the
plant; up is +y here, and down in the viewer, so every shape and pose is turned over on its way
(:func:`upright`, :func:`poses`).
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from cosim.output.palette import CONTROLLER, PLANT, SENSOR, Colour

Reals = NDArray[np.float64]

TIMELINE = "t"
PICTURE = "picture"
"""What all entities of a picture are below."""
WHO: Mapping[str, Colour] = {"plant": PLANT, "sensor": SENSOR, "controller": CONTROLLER}
"""Whose state a body shows: the plant's own, and where the two models believe it to be."""
NAMES: Mapping[str, str] = {
    "plant": "x plant",
    "sensor": "x_s sensor model",
    "controller": "x_c controller model",
}
STILL: Colour = (128, 132, 138)
"""Of what does not move: roads, rails, axes."""

TRAIL_S = 3.0

_FAR = 1e4
_FRONT = 10.0

Columns = rr.ComponentColumnList
Shape = rr.LineStrips2D | rr.Points2D | rr.Boxes2D


class Frames(NamedTuple):
    """States at k times; n states, m inputs, N states of the system itself."""

    t_s: Reals
    """(k,) ascending."""
    x: Reals
    """(k, n) the plant's."""
    x_s: Reals
    """(k, n) the sensor model's."""
    x_c: Reals
    """(k, n) the controller model's; NaN where it is not on record."""
    z: Reals | None = None
    """(k, N) the system's own, of a plant that is not linear; NaN where it is not on record."""

    def at(self, which: NDArray[np.bool_]) -> "Frames":
        """Some of them."""
        z = None if self.z is None else self.z[which]
        return Frames(self.t_s[which], self.x[which], self.x_s[which], self.x_c[which], z)

    def of(self, who: str) -> Reals:
        """The state, in the loop's coordinates, that one of ``WHO`` has or believes, (k, n)."""
        return {"plant": self.x, "sensor": self.x_s, "controller": self.x_c}[who]


def joined(batches: Sequence[Frames]) -> Frames:
    """Frames that follow each other, as one batch."""
    own = [frames.z for frames in batches if frames.z is not None]
    return Frames(
        np.concatenate([frames.t_s for frames in batches]),
        np.concatenate([frames.x for frames in batches]),
        np.concatenate([frames.x_s for frames in batches]),
        np.concatenate([frames.x_c for frames in batches]),
        np.concatenate(own) if own else None,
    )


class Picture(Protocol):
    """One plant's picture; entities are named below ``PICTURE``."""

    title: str
    """Of its panel."""
    rate_hz: float
    """Frames per second of simulated time."""
    trails: tuple[str, ...]
    """Entities of which the last ``TRAIL_S`` are in sight, not only the newest."""

    def bounds(self) -> tuple[float, float, float, float]:
        """What is in sight: left, right, bottom, top."""
        ...

    def scenery(self) -> Mapping[str, Shape]:
        """The shapes, by entity; each is recorded once."""
        ...

    def frames(self, frames: Frames) -> Mapping[str, Columns]:
        """What moves them: columns of k rows, by entity."""
        ...


def panel(picture: Picture) -> rrb.Spatial2DView:
    """The view of a picture."""
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
        overrides={
            f"{PICTURE}/{entity}": rrb.VisibleTimeRanges([past]) for entity in picture.trails
        },
    )


def upright(points: Sequence[Sequence[float]] | Reals) -> Reals:
    """Points (..., 2) with up for +y, for the viewer."""
    return np.asarray(points, dtype=np.float64) * (1.0, -1.0)


def lines(
    strips: Sequence[Sequence[Sequence[float]]],
    colour: Colour,
    width: float,
    *,
    order: float = 0.0,
) -> rr.LineStrips2D:
    """Lines through points, as wide as ``width``; what is of higher ``order`` is in front."""
    return rr.LineStrips2D(
        [upright(strip) for strip in strips], radii=width / 2, colors=colour, draw_order=order
    )


def style(colour: Colour, width: float, *, order: float = 0.0) -> rr.LineStrips2D:
    """How lines look that each frame draws anew (:func:`strips`)."""
    return rr.LineStrips2D.from_fields(radii=width / 2, colors=colour, draw_order=order)


def label(
    text: str, at: tuple[float, float], colour: Colour, *, order: float = _FRONT
) -> rr.Points2D:
    """A text below a point."""
    return rr.Points2D(
        upright([at]), radii=0.0, colors=colour, labels=text, show_labels=True, draw_order=order
    )


def legend(left: float, top: float, step: float) -> dict[str, Shape]:
    """Say whose is which, one below the other, centred on the place given."""
    return {
        f"legend/{who}": label(NAMES[who], (left, top - i * step), colour)
        for i, (who, colour) in enumerate(WHO.items())
    }


def poses(x: Reals, y: Reals, angle_rad: Reals | None = None) -> Columns:
    """Transforms that put a shape at places (k,), turned anticlockwise by angles (k,) if any.

    What is not a number, or far out of sight, is put where nobody looks.
    """
    place = np.nan_to_num(np.column_stack([x, -y, np.zeros_like(x)]), nan=_FAR, posinf=_FAR)
    translation = np.clip(place, -_FAR, _FAR).astype(np.float32)
    if angle_rad is None:
        return rr.Transform3D.columns(translation=translation)
    half = -0.5 * np.nan_to_num(angle_rad, posinf=0.0, neginf=0.0)
    turn = np.zeros((len(x), 4), dtype=np.float32)
    turn[:, 2], turn[:, 3] = np.sin(half), np.cos(half)
    return rr.Transform3D.columns(translation=translation, quaternion=turn)


def strips(points: Reals) -> Columns:
    """One line a frame, through points (k, p, 2)."""
    return rr.LineStrips2D.columns(strips=clipped(upright(points)))


def clipped(points: Reals) -> NDArray[np.float32]:
    """Points as the recording keeps them; what is no place is put where nobody looks."""
    return np.clip(np.nan_to_num(points, nan=_FAR), -_FAR, _FAR).astype(np.float32)


def outline(
    corners: Sequence[Sequence[float]], dash: float | None = None
) -> list[list[list[float]]]:
    """A closed line through corners, or dashes along it of the length given.

    Beside a whole line, one of dashes can be told apart without colours.
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
