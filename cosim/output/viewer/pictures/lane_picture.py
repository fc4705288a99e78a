"""A car on its lane, seen from above, and the positions of its two models.

The picture moves with the car: the lane's markings pass by.
"""

from collections.abc import Mapping

import numpy as np

from cosim.output.figures.palette import Colour
from cosim.output.viewer.pictures import picture as draw

_LANE_M = 3.5
_MARK_M, _MARKS_EVERY_M, _POSTS_EVERY_M = 3.0, 9.0, 18.0
_LENGTH_M, _WIDTH_M = 4.5, 1.8
_AXLE_M, _TRACK_M, _WHEEL_M = 1.35, 0.9, 0.7
_BEHIND_M, _AHEAD_M, _HIGH_M = 9.0, 15.0, 5.7
_GLASS: Colour = (58, 62, 70)


class LanePicture(draw.Picture):
    """A car on a straight lane, drawn from its lateral offset and yaw.

    Args:
        lateral, yaw: index of the lateral offset (m) and of the yaw (rad) in x.
        forward_mps: U of the model's dY_g/dt = V + U ψ. If it is negative, as in the paper, the
            picture is mirrored, so that the car moves to the right and a positive Y_g is up.
    """

    title = "The car on its lane"

    def __init__(self, lateral: int, yaw: int, *, forward_mps: float = 0.0) -> None:
        self._lateral, self._yaw = lateral, yaw
        self._forward_mps = forward_mps
        self._hand = -1.0 if forward_mps < 0 else 1.0

    @classmethod
    def of(cls, plant: draw.DrawnPlant) -> "LanePicture | None":
        at = plant.places("Y_g", "psi")
        # The paper's dY_g/dt = V + U ψ.
        return cls(*at, forward_mps=float(plant.loop.A_model[at])) if at else None

    def bounds(self) -> tuple[float, float, float, float]:
        return -_BEHIND_M, _AHEAD_M, -_HIGH_M, _HIGH_M

    def scenery(self) -> Mapping[str, draw.Shape]:
        edge, between = 1.5 * _LANE_M, 0.5 * _LANE_M
        left, right = -_BEHIND_M - _POSTS_EVERY_M, _AHEAD_M + 2 * _POSTS_EVERY_M
        marks = np.arange(round(left / _MARKS_EVERY_M), round(right / _MARKS_EVERY_M))
        posts = np.arange(round(left / _POSTS_EVERY_M), round(right / _POSTS_EVERY_M))
        return {
            "road/edges": draw.lines([[(left, y), (right, y)] for y in (-edge, edge)], draw.STILL, 0.15),
            "road/middle": draw.lines([[(left, 0.0), (right, 0.0)]], draw.STILL, 0.03),
            "road/passing": draw.lines(
                [
                    *(
                        [(start, y), (start + _MARK_M, y)]
                        for start in (marks * _MARKS_EVERY_M).tolist()
                        for y in (-between, between)
                    ),
                    *(
                        [(at, side * edge), (at, side * (edge + 0.4))]
                        for at in (posts * _POSTS_EVERY_M).tolist()
                        for side in (-1.0, 1.0)
                    ),
                ],
                draw.STILL,
                0.15,
            ),
            **self._car(),
            "sensor/outline": draw.body("sensor", draw.outline(_corners(0.1)), 0.13),
            "controller/outline": draw.body("controller", draw.outline(_corners(0.28), 0.3), 0.2),
        } | draw.legend(_AHEAD_M - 3.9, _HIGH_M - 0.6, 1.1)

    def frames(self, frames: draw.Frames) -> Mapping[str, draw.Columns]:
        k = len(frames.t_s)
        zero = np.zeros(k)
        columns: dict[str, draw.Columns] = {}
        for who in draw.WHO:
            x = frames.of(who)
            columns[who] = draw.poses(zero, x[:, self._lateral], self._hand * x[:, self._yaw])
        along = abs(self._forward_mps) * frames.t_s
        columns["road/passing"] = draw.poses(-np.remainder(along, _POSTS_EVERY_M), zero)
        return columns

    def _car(self) -> dict[str, draw.Shape]:
        half = _LENGTH_M / 2
        wheels = [(x, y) for x in (-_AXLE_M, _AXLE_M) for y in (_TRACK_M, -_TRACK_M)]
        round_m = 0.35
        inner, across = half - round_m, _WIDTH_M / 2 - round_m
        panels = [[(-inner, y), (inner, y)] for y in np.linspace(-across, across, 4).tolist()]
        glass = [
            [(0.75, -0.55), (0.95, 0.0), (0.75, 0.55)],
            [(-1.35, -0.5), (-1.35, 0.5)],
        ]
        return {
            "plant/wheels": draw.lines([_wheel(x, y) for x, y in wheels], _GLASS, 0.3, order=1.0),
            "plant/body": draw.body("plant", panels, 2 * round_m),
            "plant/glass": draw.lines(glass, _GLASS, 0.3, order=2.5),
        }


def _wheel(x: float, y: float) -> list[tuple[float, float]]:
    return [(x - _WHEEL_M / 2, y), (x + _WHEEL_M / 2, y)]


def _corners(beyond: float) -> list[tuple[float, float]]:
    """Return an outline around the car, with a nose that shows its direction."""
    x, y = _LENGTH_M / 2 + beyond, _WIDTH_M / 2 + beyond
    return [(-x, -y), (x - 0.5, -y), (x, -y + 0.5), (x, y - 0.5), (x - 0.5, y), (-x, y)]
