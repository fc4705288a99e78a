import numpy as np


class Delayed:
    """x+ = 0.905 x + 0.095 z, z+ = u: a dead time of one sample."""

    def start(self, x0):
        self.x = np.array(x0, float)

    def advance(self, u, t_s, dt_s):
        self.x = np.array([0.905 * self.x[0] + 0.095 * self.x[1], u[0]])
