"""The quadruple-tank process: Bernoulli's law at each outlet."""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from netem.core.settings_section import Positive
from noack.core.linear_systems import Vector
from noack.plants.plant_settings import EquationSettings, PlantEquations, at_least, sqrt

Share = Annotated[FiniteFloat, Field(gt=0, lt=1)]


class FourTankSettings(EquationSettings):
    """Four tanks: each of two pumps fills one lower tank and the tank above the other lower one.

    Johansson, "The Quadruple-Tank Process", IEEE Trans. Control Systems Technology 8(3), 2000; the
    default parameters are its minimum-phase P₋. u is the deviation from the operating voltages, x
    the deviation from the levels that these voltages maintain.
    """

    states: ClassVar = ("level 1, cm", "level 2, cm", "level 3, cm", "level 4, cm")
    inputs: ClassVar = ("pump 1, V", "pump 2, V")
    scenario: ClassVar = "four_tank"

    kind: Literal["four_tank"]
    areas_cm2: tuple[Positive, Positive, Positive, Positive] = (28.0, 32.0, 28.0, 32.0)
    """Cross-sections of the tanks; tanks 1 and 2 are below tanks 3 and 4."""
    holes_cm2: tuple[Positive, Positive, Positive, Positive] = (0.071, 0.057, 0.071, 0.057)
    """Cross-sections of the tanks' outlets."""
    pumps_cm3_per_v_s: tuple[Positive, Positive] = (3.33, 3.35)
    """Flow of each pump per volt."""
    valves: tuple[Share, Share] = (0.70, 0.60)
    """Shares of the pumps' flows that go to the lower tanks; pump 1 fills tanks 1 and 4, pump 2
    tanks 2 and 3. If their sum is above 1, the process is minimum-phase."""
    voltages_v: tuple[Positive, Positive] = (3.0, 3.0)
    """Voltages of the pumps at the operating point."""
    gravity_cm_per_s2: Positive = 981.0
    """Gravity."""

    @property
    def internal_names(self) -> tuple[str, ...]:
        """The levels themselves, cm."""
        return ("level_1", "level_2", "level_3", "level_4")

    def equations(self) -> PlantEquations:
        """Return the equations; z is the levels h, v the pumps' voltages.

        A₁ḣ₁ = −o₁ + o₃ + γ₁k₁v₁, A₂ḣ₂ = −o₂ + o₄ + γ₂k₂v₂, A₃ḣ₃ = −o₃ + (1−γ₂)k₂v₂ and
        A₄ḣ₄ = −o₄ + (1−γ₁)k₁v₁ with oᵢ = aᵢ√(2ghᵢ): Johansson (2000), Section II. An empty tank
        has no outflow, and a pump with a negative voltage has no flow.
        """
        areas, holes = self.areas_cm2, self.holes_cm2
        twice_gravity = 2 * self.gravity_cm_per_s2
        (k1, k2), (share1, share2) = self.pumps_cm3_per_v_s, self.valves
        voltages = np.array(self.voltages_v)

        def inflows(v1: float, v2: float) -> tuple[float, float, float, float]:
            flow1, flow2 = k1 * at_least(v1, 0.0), k2 * at_least(v2, 0.0)
            return share1 * flow1, share2 * flow2, (1 - share2) * flow2, (1 - share1) * flow1

        def derivative(t_s: float, h: Vector, v: Vector) -> tuple[float, ...]:
            out1, out2, out3, out4 = (
                hole * sqrt(twice_gravity * at_least(level, 0.0))
                for hole, level in zip(holes, h.tolist(), strict=True)
            )
            in1, in2, in3, in4 = inflows(*v.tolist())
            return (
                (in1 + out3 - out1) / areas[0],
                (in2 + out4 - out2) / areas[1],
                (in3 - out3) / areas[2],
                (in4 - out4) / areas[3],
            )

        in1, in2, in3, in4 = inflows(*voltages.tolist())
        with np.errstate(over="ignore"):  # extreme settings lead to infinite levels
            speeds = np.array((in1 + in3, in2 + in4, in3, in4)) / holes
            levels = speeds**2 / twice_gravity
        return PlantEquations(
            derivative,
            initial=lambda x0: np.maximum(levels + x0, 0.0),
            output=lambda h: h - levels,
            physical=lambda u: voltages + u,
            is_recorded=True,
        )
