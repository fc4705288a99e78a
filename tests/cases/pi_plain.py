import numpy as np


class PI:
    """Speed PI with clamping anti-windup; input 0 when no update for the survival time."""

    def __init__(
        self, kp=0.024, ki=0.6, limit=24.0, survival_s=0.03, dead_s=0.025, steps=((0.5, 200.0), (2.5, 100.0))
    ):
        self.kp, self.ki, self.limit = kp, ki, limit
        self.survival = survival_s + dead_s
        self.steps = steps
        self.integral, self.last, self.w = 0.0, None, 0.0

    def start(self, model):
        self.T = model.period_s

    def on_update(self, t_s, x):
        self.last, self.w = t_s, x[0]

    def on_tick(self, t_s, x_c):
        r = 0.0
        for at, value in self.steps:
            if t_s >= at:
                r = value
        if self.last is None or t_s - self.last > self.survival + 1e-9:
            return np.zeros(1)
        e = r - self.w
        u = self.kp * e + self.ki * self.integral
        if abs(u) < self.limit or u * e < 0:
            self.integral += e * self.T
        return np.array([np.clip(u, -self.limit, self.limit)])
