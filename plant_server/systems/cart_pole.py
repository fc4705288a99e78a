"""A pole upright on a cart: the exact equations of motion, friction of the cart included."""

import math

from noack.config.plant_systems import CartPoleSettings
from noack.core.linear_systems import Vector
from plant_server.ode_integrator import OdeSystem


def cart_pole(settings: CartPoleSettings, x0: Vector) -> OdeSystem:
    """Return the system; its own state is x: position, velocity, angle from upright, its rate.

    With q the position and θ the angle, positive towards positive q:
    (M + m) q̈ + m l cos θ θ̈ − m l sin θ θ̇² + b q̇ = F and (I + m l²) θ̈ + m l cos θ q̈ = m g l sin θ.

    Args:
        settings: masses, lengths, friction, gravity.
        x0: x(0), shape (4,).
    """
    total = settings.cart_kg + settings.pole_kg
    moment = settings.pole_kg * settings.length_m
    inertia = settings.inertia_kg_m2 + moment * settings.length_m
    friction, gravity = settings.friction_n_s_per_m, settings.gravity_m_per_s2

    def derivative(t_s: float, z: Vector, force: Vector) -> tuple[float, ...]:
        _, velocity, angle, rate = z.tolist()
        sine, cosine = math.sin(angle), math.cos(angle)
        pushed = float(force[0]) - friction * velocity + moment * sine * rate * rate
        falling = moment * gravity * sine
        determinant = total * inertia - (moment * cosine) ** 2
        acceleration = (inertia * pushed - moment * cosine * falling) / determinant
        turning = (total * falling - moment * cosine * pushed) / determinant
        return velocity, acceleration, rate, turning

    return OdeSystem(derivative, x0, internal=False)
