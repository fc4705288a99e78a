"""A quadrotor: the equations of Newton and Euler of a rigid body in the air."""

import math

from noack.config.plant_systems import QuadrotorSettings
from noack.core.linear_systems import Vector
from plant_server.ode_integrator import OdeSystem


def quadrotor(settings: QuadrotorSettings, x0: Vector) -> OdeSystem:
    """Return the system; its own state is x: position, roll φ, pitch θ, yaw ψ, velocity, rates.

    With R = R_z(ψ) R_y(θ) R_x(φ) from body to world and thrust T = mg + u₁:
    m v̇ = R (0, 0, T) − (0, 0, mg) − D v, I ω̇ = τ − ω × Iω, and the angles' rates are those that
    turn R by the body's rates ω = (p, q, r): Luukkonen (2011), Sections 2.1 and 2.3, without the
    rotors' own momentum. Angles of a body whose nose points up or down are none.

    Args:
        settings: mass, inertia, drag, gravity.
        x0: x(0), shape (12,).
    """
    mass, gravity = settings.mass_kg, settings.gravity_m_per_s2
    inertia_x, inertia_y, inertia_z = settings.inertia_kg_m2
    drag_x, drag_y, drag_z = settings.drag_kg_per_s

    def derivative(t_s: float, z: Vector, v: Vector) -> tuple[float, ...]:
        _, _, _, roll, pitch, yaw, v_x, v_y, v_z, p, q, r = z.tolist()
        beyond, torque_x, torque_y, torque_z = v.tolist()
        sin_roll, cos_roll = math.sin(roll), math.cos(roll)
        sin_pitch, cos_pitch = math.sin(pitch), math.cos(pitch)
        sin_yaw, cos_yaw = math.sin(yaw), math.cos(yaw)
        lift = gravity + beyond / mass
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

    return OdeSystem(derivative, x0, internal=False)
