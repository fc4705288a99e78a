"""The quadruple-tank process: Bernoulli's law at each outlet."""

import math

import numpy as np

from noack.config.plant_systems import FourTankSettings
from noack.core.linear_systems import Vector
from plant_server.ode_integrator import OdeSystem


def four_tank(settings: FourTankSettings, x0: Vector) -> OdeSystem:
    """Return the system; its own state is the levels h, and v the pumps' voltages.

    A₁ḣ₁ = −o₁ + o₃ + γ₁k₁v₁, A₂ḣ₂ = −o₂ + o₄ + γ₂k₂v₂, A₃ḣ₃ = −o₃ + (1−γ₂)k₂v₂ and
    A₄ḣ₄ = −o₄ + (1−γ₁)k₁v₁ with oᵢ = aᵢ√(2ghᵢ): Johansson (2000), Section II. An empty tank gives
    nothing, a pump does not draw.

    Args:
        settings: areas, pumps, valves, operating voltages.
        x0: x(0), levels beyond the operating point's, cm, shape (4,).
    """
    areas, holes = settings.areas_cm2, settings.holes_cm2
    twice_gravity = 2 * settings.gravity_cm_per_s2
    (k1, k2), (below1, below2) = settings.pumps_cm3_per_v_s, settings.valves
    voltages = np.array(settings.voltages_v)

    def filled(v1: float, v2: float) -> tuple[float, float, float, float]:
        one, two = k1 * max(v1, 0.0), k2 * max(v2, 0.0)
        return below1 * one, below2 * two, (1 - below2) * two, (1 - below1) * one

    def derivative(t_s: float, h: Vector, v: Vector) -> tuple[float, ...]:
        out1, out2, out3, out4 = (
            hole * math.sqrt(twice_gravity * max(level, 0.0))
            for hole, level in zip(holes, h.tolist(), strict=True)
        )
        in1, in2, in3, in4 = filled(*v.tolist())
        return (
            (in1 + out3 - out1) / areas[0],
            (in2 + out4 - out2) / areas[1],
            (in3 - out3) / areas[2],
            (in4 - out4) / areas[3],
        )

    in1, in2, in3, in4 = filled(*voltages.tolist())
    with np.errstate(over="ignore"):  # of absurd settings the levels are infinite
        speeds = np.array((in1 + in3, in2 + in4, in3, in4)) / holes
        levels = speeds**2 / twice_gravity
    return OdeSystem(
        derivative,
        np.maximum(levels + x0, 0.0),
        output=lambda h: h - levels,
        physical=lambda u: voltages + u,
    )
