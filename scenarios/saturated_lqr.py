"""A linear-quadratic regulator with an actuator limit: an example of controller.kind = "python"."""

import numpy as np
from scipy.linalg import expm, solve_discrete_are


class SaturatedLqr:
    """u = clip(−F x_c, ±limit), F of the discrete-time regulator with held inputs.

    Args:
        state_weights: diagonal of Q, n entries.
        input_weights: diagonal of R, m entries.
        limit: largest absolute value of each input.
    """

    def __init__(self, state_weights, input_weights, limit):
        self._Q, self._R = np.diag(state_weights), np.diag(input_weights)
        self._limit = np.asarray(limit)

    def start(self, model):
        """Compute F from Â, B̂ and the time between two ticks."""
        n, m = model.B.shape
        block = np.zeros((n + m, n + m))
        block[:n] = np.hstack([model.A, model.B])
        step = expm(block * model.period_s)
        Ad, Bd = step[:n, :n], step[:n, n:]
        P = solve_discrete_are(Ad, Bd, self._Q, self._R)
        self.F = np.linalg.solve(self._R + Bd.T @ P @ Bd, Bd.T @ P @ Ad)

    def on_tick(self, t_s, x_c):
        """Return u for the model state x_c."""
        return np.clip(-self.F @ x_c, -self._limit, self._limit)
