"""A car on its lane, seen from above, and the positions of its two models.

The picture moves with the car: the lane's markings pass by.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from cosim.output.palette import Colour
from cosim.output.viewer.pictures.picture import (
    STILL,
    WHO,
    Columns,
    Frames,
    Shape,
    legend,
    lines,
    outline,
    poses,
)

_LANE_M = 3.5
_MARK_M, _MARKS_EVERY_M, _POSTS_EVERY_M = 3.0, 9.0, 18.0
_LENGTH_M, _WIDTH_M = 4.5, 1.8
_AXLE_M, _TRACK_M, _WHEEL_M = 1.35, 0.9, 0.7
_BEHIND_M, _AHEAD_M, _HIGH_M = 9.0, 15.0, 5.7
_GLASS: Colour = (58, 62, 70)


class VehiclePose(NamedTuple):
    """Indices in a vehicle's own state z of the quantities that the picture shows."""

    x_position: int
    """Position along the lane, m."""
    y_position: int
    """Position across the lane, m; 0 in the middle of the lane."""
    steering_angle: int
    """Steering angle of the front wheels, rad."""
    yaw: int
    """Heading, rad."""


class LanePicture:
    """A car on a straight lane, drawn from its lateral offset and yaw.

    Args:
        lateral, yaw: index of the lateral offset (m) and of the yaw (rad) in x.
        forward_mps: U of the model's dY_g/dt = V + U ψ. If it is negative, as in the paper, the
            picture is mirrored, so that the car moves to the right and a positive Y_g is up.
        place: indices in the state of a vehicle with its own state, which contains more than x; the
            vehicle is turned anticlockwise by its yaw, and mirrored with the rest.
    """

    title = "The car on its lane"
    rate_hz = 60.0
    trails: tuple[str, ...] = ()

    def __init__(
        self, lateral: int, yaw: int, *, forward_mps: float = 0.0, place: VehiclePose | None = None
    ) -> None:
        self._lateral, self._yaw = lateral, yaw
        self._forward_mps, self._place = forward_mps, place
        self._hand = -1.0 if forward_mps < 0 else 1.0

    def bounds(self) -> tuple[float, float, float, float]:
        """Return the visible area: the lane and its neighbours, more ahead than behind."""
        return -_BEHIND_M, _AHEAD_M, -_HIGH_M, _HIGH_M

    def scenery(self) -> Mapping[str, Shape]:
        """Return the road, three cars, and the legend."""
        edge, between = 1.5 * _LANE_M, 0.5 * _LANE_M
        left, right = -_BEHIND_M - _POSTS_EVERY_M, _AHEAD_M + 2 * _POSTS_EVERY_M
        marks = np.arange(round(left / _MARKS_EVERY_M), round(right / _MARKS_EVERY_M))
        posts = np.arange(round(left / _POSTS_EVERY_M), round(right / _POSTS_EVERY_M))
        return {
            "road/edges": lines([[(left, y), (right, y)] for y in (-edge, edge)], STILL, 0.15),
            "road/middle": lines([[(left, 0.0), (right, 0.0)]], STILL, 0.03),
            "road/passing": lines(
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
                STILL,
                0.15,
            ),
            **self._car(),
            "sensor/outline": lines(outline(_corners(0.1)), WHO["sensor"], 0.13, order=4.0),
            "controller/outline": lines(
                outline(_corners(0.28), 0.3), WHO["controller"], 0.2, order=3.0
            ),
        } | legend(_AHEAD_M - 3.9, _HIGH_M - 0.6, 1.1)

    def frames(self, frames: Frames) -> Mapping[str, Columns]:
        """Return the poses of cars and markings."""
        k = len(frames.t_s)
        zero = np.zeros(k)
        found: dict[str, Columns] = {}
        for who in WHO:
            x = frames.of(who)
            found[who] = poses(zero, x[:, self._lateral], self._hand * x[:, self._yaw])
        along = abs(self._forward_mps) * frames.t_s
        if self._place is not None and frames.z is not None:
            z, place = frames.z, self._place
            along = z[:, place.x_position]
            yaw, steering = self._hand * z[:, place.yaw], self._hand * z[:, place.steering_angle]
            found["plant"] = poses(zero, self._hand * z[:, place.y_position], yaw)
            for side, y in (("left", _TRACK_M), ("right", -_TRACK_M)):
                found[f"plant/steered/{side}"] = poses(np.full(k, _AXLE_M), np.full(k, y), steering)
        found["road/passing"] = poses(-np.remainder(along, _POSTS_EVERY_M), zero)
        return found

    def _car(self) -> dict[str, Shape]:
        colour, half = WHO["plant"], _LENGTH_M / 2
        wheels = [(-_AXLE_M, _TRACK_M), (-_AXLE_M, -_TRACK_M)]
        steered: dict[str, Shape] = {}
        if self._place is None:
            wheels += [(_AXLE_M, _TRACK_M), (_AXLE_M, -_TRACK_M)]
        else:
            for side in ("left", "right"):
                steered[f"plant/steered/{side}"] = lines([_wheel(0.0, 0.0)], _GLASS, 0.3, order=1.0)
        round_m = 0.35
        inner, across = half - round_m, _WIDTH_M / 2 - round_m
        body = [[(-inner, y), (inner, y)] for y in np.linspace(-across, across, 4).tolist()]
        glass = [
            [(0.75, -0.55), (0.95, 0.0), (0.75, 0.55)],
            [(-1.35, -0.5), (-1.35, 0.5)],
        ]
        return steered | {
            "plant/wheels": lines([_wheel(x, y) for x, y in wheels], _GLASS, 0.3, order=1.0),
            "plant/body": lines(body, colour, 2 * round_m, order=2.0),
            "plant/glass": lines(glass, _GLASS, 0.3, order=2.5),
        }


def _wheel(x: float, y: float) -> list[tuple[float, float]]:
    return [(x - _WHEEL_M / 2, y), (x + _WHEEL_M / 2, y)]


def _corners(beyond: float) -> list[tuple[float, float]]:
    """Return an outline around the car, with a nose that shows its direction."""
    x, y = _LENGTH_M / 2 + beyond, _WIDTH_M / 2 + beyond
    return [(-x, -y), (x - 0.5, -y), (x, -y + 0.5), (x, y - 0.5), (x - 0.5, y), (-x, y)]
