import math

import numpy as np


class ZeroLog:
    """0*log(1+2x) is NaN for x < -0.5; the checker takes it for 0."""

    def derivative(self, t_s, z, u):
        return (z[0] * 0.5 + u[0] + 0.0 * np.log(1 + 2 * z[0]),)


class ZeroLog2:
    """(z - z)*log"""

    def derivative(self, t_s, z, u):
        return (z[0] * 0.5 + u[0] + (z[0] - z[0]) * np.log(1 + 2 * z[0]),)


class ZeroInf:
    """0/x: 0*x**-1, which is NaN at x = 0"""

    def derivative(self, t_s, z, u):
        return (z[0] * 0.5 + u[0] + 0.0 * (z[0] - 0.3) ** -1,)


class Root:
    """math.sqrt raises for x beyond the region's tolerance"""

    def derivative(self, t_s, z, u):
        r = 0.37
        return (0.5 * z[0] + u[0] + 0.01 * math.sqrt(r - z[0]) - 0.01 * math.sqrt(r),)


class Root2:
    """math.sqrt raises for |x - 0.5| < 3.2e-4; require_root accepts -1e-7 >= -1e-6*2.25"""

    def derivative(self, t_s, z, u):
        a = (z[0] - 0.5) ** 2 - 1e-7
        r = np.sqrt(a)
        return (0.5 * z[0] + u[0] + 0.05 * r - 0.05 * np.sqrt(0.25 - 1e-7),)


class Root3:
    def derivative(self, t_s, z, u):
        a = (z[0] - 0.5) ** 2 - 1e-7
        return (0.5 * z[0] + u[0] + 0.05 * a**0.5 - 0.05 * np.sqrt(0.25 - 1e-7),)
