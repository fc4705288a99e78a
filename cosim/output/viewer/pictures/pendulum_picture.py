"""An upright pendulum on a pivot, or on a cart on a rail; or a cart alone.

The angle is measured from upright, in radians; positive is a lean to the right, towards +position.
"""

from collections.abc import Mapping

import numpy as np

from cosim.output.viewer.pictures import picture as draw
from cosim.record.align import Reals
from noack.plants.cart_pole import CartPoleSettings

_CART_LENGTH, _CART_HEIGHT = 0.5, 0.22
"""As shares of the scale of the picture."""
_WIDTHS: Mapping[str, float] = {"plant": 0.075, "sensor": 0.022, "controller": 0.03}


class PendulumPicture(draw.Picture):
    """Poles and carts: plant solid, sensor's model outlined, controller's model dashed.

    Args:
        position: index of the cart's position in x, in metres; None for a fixed pivot.
        angle: index of the pole's angle in x, in radians; None for a cart alone.
        reach_m: maximum distance of the cart from 0.
        pole_m: length of the pole; if the cart moves far, cart and pole are drawn larger.
    """

    kinds = ("cart_pole",)

    def __init__(
        self,
        position: int | None,
        angle: int | None,
        *,
        reach_m: float = 0.0,
        pole_m: float = 1.0,
    ) -> None:
        self._position, self._angle = position, angle
        self.title = {
            (False, True): "The angle, from upright",
            (True, True): "The cart and its pole",
            (True, False): "The cart on its rail",
        }[position is not None, angle is not None]
        # Scale of the drawing; its lengths are in units of the pole's length.
        self._scale = max(reach_m / 1.8, pole_m)
        self._wide = (2.3 if position is not None else 1.6) * self._scale

    @classmethod
    def of(cls, plant: draw.DrawnPlant) -> "PendulumPicture | None":
        system = plant.scenario.plant.system
        if isinstance(system, CartPoleSettings):
            return cls(0, 2, reach_m=float(plant.reach[0]), pole_m=2 * system.length_m)
        if at := plant.places("position", "angle"):
            return cls(*at, reach_m=float(plant.reach[at[0]]))
        if at := plant.places("angle"):
            return cls(None, at[0])
        if at := plant.places("position", "velocity"):
            return cls(at[0], None, reach_m=float(plant.reach[at[0]]))
        return None

    def bounds(self) -> tuple[float, float, float, float]:
        high = 1.35 * self._scale
        low = (-0.55 if self._position is not None else -0.4) * self._scale
        return -self._wide, self._wide, low, high

    def scenery(self) -> Mapping[str, draw.Shape]:
        scale = self._scale
        shapes: dict[str, draw.Shape] = {}
        if self._position is None:
            foot = [(-0.16 * scale, -0.1 * scale), (0.0, 0.0), (0.16 * scale, -0.1 * scale)]
            shapes["pivot"] = draw.lines([foot], draw.STILL, 0.04 * scale)
            shapes["upright"] = draw.lines([[(0.0, 0.0), (0.0, 1.15 * scale)]], draw.STILL, 0.008 * scale)
        else:
            ground = -(_CART_HEIGHT / 2 + 0.03) * scale
            ends = (-2 * self._wide, 2 * self._wide)
            step = 10.0 ** np.floor(np.log10(self._wide))
            ticks = (step * np.arange(-10, 11)).tolist()
            shapes["rail"] = draw.lines([[(ends[0], ground), (ends[1], ground)]], draw.STILL, 0.03 * scale)
            shapes["rail/ticks"] = draw.lines(
                [[(at, ground), (at, ground - 0.08 * scale)] for at in ticks],
                draw.STILL,
                0.02 * scale,
            )
            shapes["rail/zero"] = draw.lines(
                [[(0.0, ground), (0.0, ground - 0.2 * scale)]], draw.STILL, 0.03 * scale
            )
        for who in draw.WHO:
            if self._position is not None:
                shapes[f"{who}/cart"] = self._cart(who)
            if self._angle is not None:
                shapes[f"{who}/pole"] = self._pole(who)
        left, _, _, top = self.bounds()
        return shapes | draw.legend(left + 0.7 * scale, top - 0.05 * scale, 0.22 * scale)

    def frames(self, frames: draw.Frames) -> Mapping[str, draw.Columns]:
        columns: dict[str, draw.Columns] = {}
        for who in draw.WHO:
            x = frames.of(who)
            zero: Reals = np.zeros(len(x))
            if self._position is not None:
                columns[who] = draw.poses(x[:, self._position], zero)
            if self._angle is not None:
                columns[f"{who}/pole"] = draw.poses(zero, zero, -x[:, self._angle])
        return columns

    def _cart(self, who: str) -> draw.Shape:
        x, y = _CART_LENGTH / 2 * self._scale, _CART_HEIGHT / 2 * self._scale
        if who == "plant":
            inner = y * 0.5
            rows = [[(-x + inner, at), (x - inner, at)] for at in (-inner, 0.0, inner)]
            return draw.body(who, rows, 2 * inner)
        corners = [(-x, -y), (x, -y), (x, y), (-x, y)]
        dash = None if who == "sensor" else 0.05 * self._scale
        return draw.body(who, draw.outline(corners, dash), _WIDTHS[who] * self._scale)

    def _pole(self, who: str) -> draw.Shape:
        high, width = self._scale, _WIDTHS[who] * self._scale
        pole = [(0.0, 0.0), (0.0, high)]
        bob = [
            (0.07 * self._scale * np.cos(a), high + 0.07 * self._scale * np.sin(a))
            for a in np.linspace(0, 2 * np.pi, 13).tolist()
        ]
        if who == "controller":
            pieces = [[(0.0, high * a), (0.0, high * (a + 0.06))] for a in np.arange(0, 0.95, 0.1)]
            return draw.body(who, [*pieces, bob], 1.4 * width)
        return draw.body(who, [pole, bob], width)
