"""A hovering quadrotor, from above and from the side, and the positions of its two models."""

from collections.abc import Mapping, Sequence

import numpy as np

from cosim.output.viewer.pictures.picture import (
    STILL,
    WHO,
    Columns,
    Frames,
    Shape,
    label,
    legend,
    lines,
    outline,
    poses,
)

_STATES = ("x", "y", "z", "roll", "pitch", "yaw")
_ARM_M = 0.3
_ORDERS: Mapping[str, float] = {"plant": 2.0, "sensor": 4.0, "controller": 3.0}
_WIDTHS: Mapping[str, float] = {"plant": 0.2, "sensor": 0.06, "controller": 0.09}


class QuadrotorPicture:
    """Two drawings side by side: from above (x to the right, y up) and from the side (x and z).

    Args:
        states: indices in x of the positions x, y, z (m, relative to the hovering position) and of
            roll, pitch and yaw (rad).
        reach_m: maximum distance from the hovering position; if it is large, the body is enlarged.
    """

    title = "The quadrotor"
    rate_hz = 60.0
    trails: tuple[str, ...] = ()

    def __init__(self, states: Sequence[int], reach_m: float) -> None:
        self._at = dict(zip(_STATES, states, strict=True))
        self._arm = max(_ARM_M, 0.3 * reach_m)
        self._reach = max(reach_m, _ARM_M) + 1.5 * self._arm
        self._apart = 1.1 * self._reach

    def bounds(self) -> tuple[float, float, float, float]:
        """Return the visible area: both drawings, their titles, room for labels on the right."""
        apart, reach = self._apart, self._reach
        return -2 * apart, 3.3 * apart, -1.1 * reach, 1.4 * reach

    def scenery(self) -> Mapping[str, Shape]:
        """Return two frames, three bodies in each, and the legend."""
        found: dict[str, Shape] = {}
        thin, edge = 0.008 * self._reach, self._reach
        for view, side in (("above", -1), ("side", 1)):
            middle = side * self._apart
            corners = [
                (middle - edge, -edge), (middle + edge, -edge),
                (middle + edge, edge), (middle - edge, edge),
            ]  # fmt: skip
            cross = [
                [(middle - edge, 0.0), (middle + edge, 0.0)],
                [(middle, -edge), (middle, edge)],
            ]
            found[f"{view}/frame"] = lines([*outline(corners), *cross], STILL, thin)
            text = {"above": "from above: x, y", "side": "from the side: x, z"}
            found[f"{view}/title"] = label(text[view], (middle, 1.3 * edge), STILL)
            for who, colour in WHO.items():
                body = (_above if view == "above" else _side)(dashed=who == "controller")
                found[f"{view}/{who}"] = lines(
                    [np.multiply(strip, self._arm).tolist() for strip in body],
                    colour,
                    _WIDTHS[who] * self._arm,
                    order=_ORDERS[who],
                )
        return found | legend(2.65 * self._apart, self._reach, 0.3 * self._reach)

    def frames(self, frames: Frames) -> Mapping[str, Columns]:
        """Return the positions and angles of the bodies."""
        found: dict[str, Columns] = {}
        for who in WHO:
            state = frames.of(who)
            x, y, z, _, pitch, yaw = (state[:, self._at[name]] for name in _STATES)
            found[f"above/{who}"] = poses(x - self._apart, y, yaw)
            # With z up, a positive pitch about +y turns the x axis down.
            found[f"side/{who}"] = poses(x + self._apart, z, -pitch)
        return found


def _above(*, dashed: bool) -> list[list[list[float]]]:
    """Return four rotors, their arms, and a nose, in units of an arm's length."""
    found: list[list[list[float]]] = [[[0.0, 0.0], [0.6, 0.0]]]
    for x in (-0.7, 0.7):
        for y in (-0.7, 0.7):
            around = np.linspace(0, 2 * np.pi, 13)[:-1]
            rotor = np.column_stack([x + 0.4 * np.cos(around), y + 0.4 * np.sin(around)])
            found += outline(rotor.tolist(), 0.07 if dashed else None)
            if not dashed:
                found.append([[0.0, 0.0], [x, y]])
    return found


def _side(*, dashed: bool) -> list[list[list[float]]]:
    """Return two arms with mast and rotor at each end, in units of an arm's length."""
    found: list[list[list[float]]] = []
    for side in (-1.0, 1.0):
        found.append([[side - 0.4, 0.25], [side + 0.4, 0.25]])
        found.append([[side, 0.0], [side, 0.25]])
    if not dashed:
        return [[[-1.0, 0.0], [1.0, 0.0]], *found]
    return [[[at, 0.0], [at + 0.13, 0.0]] for at in np.arange(-1, 1, 0.26).tolist()] + found
