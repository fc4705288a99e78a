"""Plants as equations of one's own, for the scenarios sine_pendulum, kinematic_car and friction_servo.

With numpy's functions, and without case distinctions, a plant's equations can be enclosed over a
region: noack certify proves that the plant does not leave it.
"""

import numpy as np


class Pendulum:
    """An inverted pendulum with a torque at its pivot; z is its angle and its rate."""

    def __init__(self, length_m=1.0, friction_per_s=0.1):
        self.stiffness, self.friction = 9.81 / length_m, friction_per_s

    def derivative(self, t_s, z, u):
        """Return dz/dt."""
        angle, rate = z
        return rate, self.stiffness * np.sin(angle) - self.friction * rate + u[0]


class KinematicCar:
    """A car whose wheels do not slip; z is its steering angle, its yaw and its lateral position.

    The input is the steering angle that a servo follows.
    """

    def __init__(self, speed_m_per_s=15.0, wheelbase_m=2.6, steering_s=0.1):
        self.speed, self.wheelbase, self.servo_s = speed_m_per_s, wheelbase_m, steering_s

    def derivative(self, t_s, z, u):
        """Return dz/dt."""
        steering, yaw, _ = z
        return (
            (u[0] - steering) / self.servo_s,
            self.speed * np.tan(steering) / self.wheelbase,
            self.speed * np.sin(yaw),
        )


class FrictionServo:
    """A servo with viscous and Coulomb friction; z is its angle and its speed, the input is a voltage.

    A tanh that bends within 2 mrad/s stands for the sign of the speed, which no integrator of differential
    equations accepts.
    """

    def __init__(self, friction_rad_per_s2=1.0, damping_per_s=2.0, gain_rad_per_v_s2=20.0):
        self.friction, self.damping, self.gain = friction_rad_per_s2, damping_per_s, gain_rad_per_v_s2

    def derivative(self, t_s, z, u):
        """Return dz/dt."""
        _, speed = z
        return speed, self.gain * u[0] - self.damping * speed - self.friction * np.tanh(speed / 0.002)
