"""A pole upright on a cart: the exact equations of motion, with the cart's friction."""

from typing import ClassVar, Literal

from netem.core.settings_section import NonNegative, Positive
from noack.core.linear_systems import Vector
from noack.plants.plant_settings import EquationSettings, PlantEquations, cos, sin


class CartPoleSettings(EquationSettings):
    """A pole on a cart; a force moves the cart on a straight rail.

    The default parameters are those of the Control Tutorials for MATLAB and Simulink (University of
    Michigan, "Inverted Pendulum"), where the angle has the opposite sign.
    """

    states: ClassVar = ("position, m", "velocity, m/s", "angle from upright, rad", "rate, rad/s")
    inputs: ClassVar = ("force, N",)
    scenario: ClassVar = "cart_pole"

    kind: Literal["cart_pole"]
    cart_kg: Positive = 0.5
    """Mass of the cart."""
    pole_kg: Positive = 0.2
    """Mass of the pole."""
    length_m: Positive = 0.3
    """Distance from the pivot to the pole's centre of mass."""
    inertia_kg_m2: NonNegative = 0.006
    """Moment of inertia of the pole about its centre of mass."""
    friction_n_s_per_m: NonNegative = 0.1
    """Viscous friction of the cart."""
    gravity_m_per_s2: Positive = 9.8
    """Gravity."""

    def equations(self) -> PlantEquations:
        """Return the equations; z is x: position, velocity, angle from upright, its rate.

        With q the position and θ the angle, positive towards positive q:
        (M + m) q̈ + m l cos θ θ̈ − m l sin θ θ̇² + b q̇ = F,
        (I + m l²) θ̈ + m l cos θ q̈ = m g l sin θ.
        """
        total = self.cart_kg + self.pole_kg
        moment = self.pole_kg * self.length_m
        inertia = self.inertia_kg_m2 + moment * self.length_m
        friction, gravity = self.friction_n_s_per_m, self.gravity_m_per_s2

        def derivative(t_s: float, z: Vector, force: Vector) -> tuple[float, ...]:
            _, velocity, angle, rate = z.tolist()
            sine, cosine = sin(angle), cos(angle)
            (applied,) = force.tolist()
            push = applied - friction * velocity + moment * sine * rate * rate
            torque = moment * gravity * sine
            determinant = total * inertia - (moment * cosine) ** 2
            acceleration = (inertia * push - moment * cosine * torque) / determinant
            angular_acceleration = (total * torque - moment * cosine * push) / determinant
            return velocity, acceleration, rate, angular_acceleration

        return PlantEquations(derivative)
