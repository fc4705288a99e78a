"""Selects a plant's picture by its kind or by the names of its states."""

from collections.abc import Sequence

import numpy as np

from cosim.output.viewer.pictures.lane_picture import LanePicture, VehiclePose
from cosim.output.viewer.pictures.pendulum_picture import PendulumPicture
from cosim.output.viewer.pictures.phase_picture import PhasePicture
from cosim.output.viewer.pictures.picture import Picture, Reals
from cosim.output.viewer.pictures.quadrotor_picture import QuadrotorPicture
from cosim.output.viewer.pictures.tanks_picture import TanksPicture
from noack.config.resolution import LoopMatrices, loop_of
from noack.config.scenario import Scenario
from noack.core.linear_systems import Propagator
from noack.plants.cart_pole import CartPoleSettings

_LEVELS = ("level_1", "level_2", "level_3", "level_4")
_SAMPLES = 400
_ROOM = 1.25


def picture_of(scenario: Scenario) -> Picture:
    """Return the picture of a resolved scenario's plant: one of its kind, or a phase plot."""
    loop, system = loop_of(scenario), scenario.plant.system
    kind: str = system.kind
    own = system.internal_names
    reach = reach_of(loop, scenario.timing.horizon_ns)
    if isinstance(system, CartPoleSettings):
        return PendulumPicture(0, 2, reach_m=float(reach[0]), pole_m=2 * system.length_m)
    if kind == "quadrotor":
        return QuadrotorPicture(range(6), float(reach[:3].max()))
    if kind == "four_tank" and (at := _places(own, _LEVELS)):
        return TanksPicture(range(4), at)
    if kind == "vehicle" and (at := _places(own, VehiclePose._fields)):
        # x is the state of the lane models: V, r, psi, Y_g.
        return LanePicture(3, 2, forward_mps=float(loop.A_model[3, 2]), place=VehiclePose(*at))
    return _of_states(loop, reach)


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


def _of_states(loop: LoopMatrices, reach: Reals) -> Picture:
    """Return a picture according to the names of the states, else a phase plot."""
    names = loop.state_names
    if at := _places(names, ("psi", "Y_g")):
        # The paper's dY_g/dt = V + U ψ.
        return LanePicture(at[1], at[0], forward_mps=float(loop.A_model[at[1], at[0]]))
    if at := _places(names, ("position", "angle")):
        return PendulumPicture(at[0], at[1], reach_m=float(reach[at[0]]))
    if at := _places(names, ("angle",)):
        return PendulumPicture(None, at[0])
    if at := _places(names, ("position", "velocity")):
        return PendulumPicture(at[0], None, reach_m=float(reach[at[0]]))
    return PhasePicture(names, reach)


def _places(names: Sequence[str], wanted: Sequence[str]) -> tuple[int, ...]:
    """Return the indices of the wanted names, if all of them exist."""
    if not set(wanted) <= set(names):
        return ()
    return tuple(names.index(name) for name in wanted)
