"""A phase plot, for a plant without its own picture: one state against another.

Both axes are scaled to the range of the model's closed loop from x(0). For a plant with one state,
each of the three states has its own line.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.output.viewer.pictures import picture as draw
from cosim.record.align import Reals

_RING_RADIUS = 0.035
_WIDTHS: Mapping[str, float] = {"plant": 0.022, "sensor": 0.009, "controller": 0.014}


class PhasePicture(draw.Picture):
    """The first state on the horizontal axis, the second on the vertical, with a trail.

    Args:
        names: names of the states.
        reach: (n,) expected maximum of each |x_i|, above 0.
    """

    draws_any = True

    def __init__(self, names: Sequence[str], reach: Reals) -> None:
        self._names = list(names[:2])
        self._reach = np.asarray(reach, dtype=float)[:2]
        self.title = " against ".join(reversed(self._names)) + ": phase plot"
        if len(self._names) == 1:
            self.title = f"{self._names[0]} of plant and models"
        self.trails = tuple(f"{who}/trail" for who in draw.WHO) if len(self._names) == 2 else ()
        self._last: dict[str, Reals] = {}

    @classmethod
    def of(cls, plant: draw.DrawnPlant) -> "PhasePicture":
        return cls(plant.loop.state_names, plant.reach)

    def bounds(self) -> tuple[float, float, float, float]:
        return -1.25, 2.8, -1.5, 1.25

    def scenery(self) -> Mapping[str, draw.Shape]:
        square = draw.outline([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        shapes: dict[str, draw.Shape] = {
            "axes": draw.lines([*square, [(-1, 0), (1, 0)], [(0, -1), (0, 1)]], draw.STILL, 0.006)
        }
        ends: list[tuple[str, float, tuple[float, float]]] = [(self._names[0], self._reach[0], (1.0, -1.0))]
        if len(self._names) == 2:
            ends.append((self._names[1], self._reach[1], (0.0, 1.17)))
        for i, (name, reach, at) in enumerate(ends):
            shapes[f"axes/{i}"] = draw.label(f"{name} = {reach:.3g}", at, draw.STILL)
        for who in draw.WHO:
            width = _WIDTHS[who]
            if who == "plant":  # filled by its line width
                shapes[f"{who}/point"] = draw.body(who, [[(-1e-3, 0), (1e-3, 0)]], 0.06)
            else:
                radius, dash = (_RING_RADIUS, None) if who == "sensor" else (1.6 * _RING_RADIUS, 0.01)
                ring = draw.outline(draw.circle(radius, 16), dash)
                shapes[f"{who}/point"] = draw.body(who, ring, 1.4 * width)
            if self.trails:
                shapes[f"{who}/trail"] = draw.trail_style(who, width)
        return shapes | draw.legend(1.95, 1.0, 0.3)

    def frames(self, frames: draw.Frames) -> Mapping[str, draw.Columns]:
        columns: dict[str, draw.Columns] = {}
        for i, who in enumerate(draw.WHO):
            points = self._scaled(frames.of(who), 0.3 - 0.3 * i)
            columns[f"{who}/point"] = draw.poses(points[:, 0], points[:, 1])
            if self.trails:
                before = np.vstack([self._last.get(who, points[:1]), points[:-1]])
                # No line to or from an unknown state.
                whole = np.isfinite(before + points).all(axis=1, keepdims=True)
                before = np.where(whole, before, points)
                columns[f"{who}/trail"] = draw.strips(np.stack([before, points], axis=1))
                self._last[who] = points[-1:]
        return columns

    def _scaled(self, states: Reals, row: float) -> Reals:
        if len(self._names) == 1:
            x = states[:, 0] / self._reach[0]
            return np.column_stack([x, np.full_like(x, row)])
        return np.asarray(states[:, :2] / self._reach)
