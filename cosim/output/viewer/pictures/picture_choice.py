"""Selects a plant's picture: the first file in this folder that draws such plants."""

import pkgutil
from importlib import import_module

import numpy as np

from cosim.output.viewer import pictures
from cosim.output.viewer.pictures.phase_picture import PhasePicture
from cosim.output.viewer.pictures.picture import DrawnPlant, Picture, Reals
from noack.config.resolution import LoopMatrices, loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Propagator

_SAMPLES = 400
_ROOM = 1.25


def picture_of(scenario: Scenario) -> Picture:
    """Return the picture of a resolved scenario's plant; a phase plot if no other draws it."""
    loop = loop_of(scenario)
    plant = DrawnPlant(scenario, loop, reach_of(loop, scenario.timing.horizon_ns))
    for module in pkgutil.iter_modules(pictures.__path__):
        import_module(f"{pictures.__name__}.{module.name}")
    kind = scenario.plant.system.kind
    for drawing in sorted(Picture.__subclasses__(), key=lambda one: kind not in one.kinds):
        if drawing is not PhasePicture and (picture := drawing.of(plant)) is not None:
            return picture
    return PhasePicture.of(plant)


def reach_of(loop: LoopMatrices, horizon_ns: int) -> Reals:
    """Return (n,) max |x_i| of the model's closed loop from x(0), plus a margin.

    It is 1 for a state that stays at 0.
    """
    step = Propagator(loop.A_model + loop.B_model @ loop.K).transition(
        max(horizon_ns // _SAMPLES, 1)
    )
    at_rest = np.zeros(loop.n) if loop.setpoint is None else loop.setpoint
    deviation, reach = loop.x0 - at_rest, np.abs(loop.x0)
    with np.errstate(all="ignore"):
        for _ in range(_SAMPLES):
            deviation = step @ deviation
            reach = np.fmax(reach, np.abs(at_rest + deviation))
    known = np.isfinite(reach) & (reach > 0)
    return np.where(known, _ROOM * reach, 1.0)
