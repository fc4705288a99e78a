"""A quadrotor: the Newton-Euler equations of a rigid body in the air."""

from typing import ClassVar, Literal

from netem.core.settings_section import NonNegative, Positive
from noack.core.linear_systems import Vector
from noack.plants.plant_settings import EquationSettings, PlantEquations, cos, sin


class QuadrotorSettings(EquationSettings):
    """A hovering rigid body: thrust along its own axis, torques about its axes, linear drag.

    The default parameters are those of Luukkonen, "Modelling and Control of Quadcopter", Aalto
    University, 2011. u is the thrust in excess of the weight, and the torques.
    """

    states: ClassVar = (
        "x, m", "y, m", "z, m", "roll, rad", "pitch, rad", "yaw, rad",
        "v_x, m/s", "v_y, m/s", "v_z, m/s",
        "roll rate p, rad/s", "pitch rate q, rad/s", "yaw rate r, rad/s",
    )  # fmt: skip
    inputs: ClassVar = (
        "thrust beyond the weight, N",
        "roll torque, N m",
        "pitch torque, N m",
        "yaw torque, N m",
    )
    scenario: ClassVar = "quadrotor_hover"

    kind: Literal["quadrotor"]
    mass_kg: Positive = 0.468
    """Mass."""
    inertia_kg_m2: tuple[Positive, Positive, Positive] = (4.856e-3, 4.856e-3, 8.801e-3)
    """Principal moments of inertia."""
    drag_kg_per_s: tuple[NonNegative, NonNegative, NonNegative] = (0.25, 0.25, 0.25)
    """Drag force per velocity, along the axes of the world."""
    gravity_m_per_s2: Positive = 9.81
    """Gravity."""

    def equations(self) -> PlantEquations:
        """Return the equations; z is x: position, roll φ, pitch θ, yaw ψ, velocity, rates.

        With R = R_z(ψ) R_y(θ) R_x(φ) from body to world and thrust T = mg + u₁: m v̇ = R (0, 0, T)
        − (0, 0, mg) − D v and I ω̇ = τ − ω × Iω. The rates of the angles follow from the rotation
        of R at the body's rates ω = (p, q, r). Source: Luukkonen (2011), Sections 2.1 and 2.3,
        without the angular momentum of the rotors. At a pitch of ±90° the angles are not defined.
        """
        mass, gravity = self.mass_kg, self.gravity_m_per_s2
        inertia_x, inertia_y, inertia_z = self.inertia_kg_m2
        drag_x, drag_y, drag_z = self.drag_kg_per_s

        def derivative(t_s: float, z: Vector, v: Vector) -> tuple[float, ...]:
            _, _, _, roll, pitch, yaw, v_x, v_y, v_z, p, q, r = z.tolist()
            extra_thrust, torque_x, torque_y, torque_z = v.tolist()
            sin_roll, cos_roll = sin(roll), cos(roll)
            sin_pitch, cos_pitch = sin(pitch), cos(pitch)
            sin_yaw, cos_yaw = sin(yaw), cos(yaw)
            lift = gravity + extra_thrust / mass
            turning = q * sin_roll + r * cos_roll
            return (
                v_x,
                v_y,
                v_z,
                p + turning * sin_pitch / cos_pitch,
                q * cos_roll - r * sin_roll,
                turning / cos_pitch,
                lift * (cos_yaw * sin_pitch * cos_roll + sin_yaw * sin_roll) - drag_x * v_x / mass,
                lift * (sin_yaw * sin_pitch * cos_roll - cos_yaw * sin_roll) - drag_y * v_y / mass,
                lift * cos_pitch * cos_roll - gravity - drag_z * v_z / mass,
                (torque_x - (inertia_z - inertia_y) * q * r) / inertia_x,
                (torque_y - (inertia_x - inertia_z) * p * r) / inertia_y,
                (torque_z - (inertia_y - inertia_x) * p * q) / inertia_z,
            )

        return PlantEquations(derivative)
