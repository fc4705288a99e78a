"""A hovering quadrotor, from above and from the side, and the positions of its two models."""

from collections.abc import Mapping

import numpy as np

from cosim.output.viewer.pictures import picture as draw

_ARM_M = 0.3
_WIDTHS: Mapping[str, float] = {"plant": 0.2, "sensor": 0.06, "controller": 0.09}


class QuadrotorPicture(draw.Picture):
    """Two drawings side by side: from above (x to the right, y up) and from the side (x and z).

    Args:
        reach_m: maximum distance from the hovering position; if it is large, the body is enlarged.
    """

    kinds = ("quadrotor",)
    title = "The quadrotor"

    def __init__(self, reach_m: float) -> None:
        self._arm = max(_ARM_M, 0.3 * reach_m)
        self._reach = max(reach_m, _ARM_M) + 1.5 * self._arm
        self._apart = 1.1 * self._reach

    @classmethod
    def of(cls, plant: draw.DrawnPlant) -> "QuadrotorPicture | None":
        if plant.scenario.plant.system.kind not in cls.kinds:
            return None
        return cls(float(plant.reach[:3].max()))

    def bounds(self) -> tuple[float, float, float, float]:
        apart, reach = self._apart, self._reach
        return -2 * apart, 3.3 * apart, -1.1 * reach, 1.4 * reach

    def scenery(self) -> Mapping[str, draw.Shape]:
        shapes: dict[str, draw.Shape] = {}
        thin, edge = 0.008 * self._reach, self._reach
        for view, side in (("above", -1), ("side", 1)):
            middle = side * self._apart
            corners = [
                (middle - edge, -edge),
                (middle + edge, -edge),
                (middle + edge, edge),
                (middle - edge, edge),
            ]
            cross = [
                [(middle - edge, 0.0), (middle + edge, 0.0)],
                [(middle, -edge), (middle, edge)],
            ]
            shapes[f"{view}/frame"] = draw.lines([*draw.outline(corners), *cross], draw.STILL, thin)
            text = {"above": "from above: x, y", "side": "from the side: x, z"}
            shapes[f"{view}/title"] = draw.label(text[view], (middle, 1.3 * edge), draw.STILL)
            for who in draw.WHO:
                strips = (_above if view == "above" else _side)(dashed=who == "controller")
                scaled = [np.multiply(strip, self._arm).tolist() for strip in strips]
                shapes[f"{view}/{who}"] = draw.body(who, scaled, _WIDTHS[who] * self._arm)
        return shapes | draw.legend(2.65 * self._apart, self._reach, 0.3 * self._reach)

    def frames(self, frames: draw.Frames) -> Mapping[str, draw.Columns]:
        columns: dict[str, draw.Columns] = {}
        for who in draw.WHO:
            state = frames.of(who)
            x, y, z, _, pitch, yaw = state[:, :6].T
            columns[f"above/{who}"] = draw.poses(x - self._apart, y, yaw)
            # With z up, a positive pitch about +y turns the x axis down.
            columns[f"side/{who}"] = draw.poses(x + self._apart, z, -pitch)
        return columns


def _above(*, dashed: bool) -> list[list[list[float]]]:
    """Return four rotors, their arms, and a nose, in units of an arm's length."""
    lines: list[list[list[float]]] = [[[0.0, 0.0], [0.6, 0.0]]]
    for x in (-0.7, 0.7):
        for y in (-0.7, 0.7):
            lines += draw.outline(draw.circle(0.4, 12, (x, y)), 0.07 if dashed else None)
            if not dashed:
                lines.append([[0.0, 0.0], [x, y]])
    return lines


def _side(*, dashed: bool) -> list[list[list[float]]]:
    """Return two arms with mast and rotor at each end, in units of an arm's length."""
    lines: list[list[list[float]]] = []
    for side in (-1.0, 1.0):
        lines.append([[side - 0.4, 0.25], [side + 0.4, 0.25]])
        lines.append([[side, 0.0], [side, 0.25]])
    if not dashed:
        return [[[-1.0, 0.0], [1.0, 0.0]], *lines]
    return [[[at, 0.0], [at + 0.13, 0.0]] for at in np.arange(-1, 1, 0.26).tolist()] + lines
