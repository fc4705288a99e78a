# ruff: noqa: RUF012
import numpy as np


class Drive2:
    """A DC drive: speed in rad/s, current in A; the drive limits its voltage to ±24 V."""

    states = ["speed, rad/s", "current, A"]
    inputs = ["voltage, V"]
    allowed = {"speed": 5.0}
    initial_state = [50.0, 0.0]

    def derivative(self, t_s, z, u):
        w, i = z
        v = np.clip(u[0], -24.0, 24.0)
        return (0.05 * i - 1e-4 * w) / 2e-4, (v - 0.5 * i - 0.05 * w) / 1e-3
