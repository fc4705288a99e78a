"""A small model predictive controller: an example of controller.kind = "python".

At each tick it minimises Σ xᵀQx + uᵀRu over a horizon, with a terminal cost, subject to limits of
the inputs and states. It predicts the present state itself, from the last update and the inputs
that it has sent since, and does not use x_c.
"""

from collections import deque

import numpy as np
from scipy.linalg import cholesky, expm, solve_discrete_are, solve_triangular
from scipy.optimize import nnls


class ModelPredictive:
    """A condensed quadratic programme, solved exactly as a least-distance problem.

    That problem is one of non-negative least squares (Lawson and Hanson, Solving Least Squares
    Problems, 1974, Chapter 23). If no input meets the limits of the states, only those of the
    inputs apply.

    Args:
        horizon: predicted ticks.
        state_weights: diagonal of Q, n entries.
        input_weights: diagonal of R, m entries.
        input_limit: largest absolute value of each input, m entries.
        state_limit: largest absolute value of each state, n entries; 0 for no limit.
    """

    def __init__(self, horizon, state_weights, input_weights, input_limit, state_limit):
        self._N = horizon
        self._Q, self._R = np.diag(state_weights), np.diag(input_weights)
        self._input_limit, self._state_limit = np.asarray(input_limit), np.asarray(state_limit)
        self._sent = deque(maxlen=200)  # (time, u) of the last ticks
        self._x, self._t_s = None, 0.0

    def start(self, model):
        """Build the programme ½ zᵀPz + (Fx)ᵀz, |Gz + Ex| ≤ h, in the stacked inputs z."""
        self._A, self._B = model.A, model.B
        (n, m), N = model.B.shape, self._N
        Ad, Bd = self._held(model.period_s)
        terminal = solve_discrete_are(Ad, Bd, self._Q, self._R)
        powers = [np.linalg.matrix_power(Ad, k) for k in range(N + 1)]
        free = np.vstack(powers[1:])
        forced = np.zeros((N * n, N * m))
        for row in range(N):
            for column in range(row + 1):
                block = powers[row - column] @ Bd
                forced[row * n : (row + 1) * n, column * m : (column + 1) * m] = block
        weights = np.kron(np.eye(N), self._Q)
        weights[-n:, -n:] = terminal
        self.P = forced.T @ weights @ forced + np.kron(np.eye(N), self._R)
        self.F = forced.T @ weights @ free
        limited = np.tile(self._state_limit > 0, N)
        self.G = np.vstack([np.eye(N * m), forced[limited]])
        self.E = np.vstack([np.zeros((N * m, n)), free[limited]])
        states = np.tile(self._state_limit, N)[limited]
        self.h = np.concatenate([np.tile(self._input_limit, N), states])
        # With P = RᵀR and y = Rz + R⁻ᵀFx, the cost is ½‖y‖², and the limits are ±Wy ≤ …, W = GR⁻¹.
        self._root = cholesky(self.P)
        self._W = solve_triangular(self._root, self.G.T, trans="T").T
        self._m = m

    def on_update(self, t_s, x):
        """Take the state that the sensor measured at t_s."""
        self._x, self._t_s = x, t_s

    def on_tick(self, t_s, x_c):
        """Return the first input of the optimal sequence."""
        x = self._predicted(t_s) if self._x is not None else x_c
        u = np.clip(self.solve(x)[: self._m], -self._input_limit, self._input_limit)
        self._sent.append((t_s, u))
        return u

    def solve(self, x):
        """Return the optimal inputs, stacked, from a state."""
        shift = solve_triangular(self._root, self.F @ x, trans="T")
        offset = self.E @ x - self._W @ shift
        for rows in (slice(None), slice(self._N * self._m)):  # all limits; those of the inputs
            W, lower, upper = (
                self._W[rows],
                -self.h[rows] - offset[rows],
                self.h[rows] - offset[rows],
            )
            y = _least_distance(np.vstack([W, -W]), np.concatenate([lower, -upper]))
            if y is not None:
                break
        else:
            y = np.zeros(len(shift))
        return solve_triangular(self._root, y - shift)

    def _predicted(self, t_s):
        """The state at a tick: the last update, advanced under the inputs sent since."""
        x, now_s = self._x, self._t_s
        u = np.zeros(self._m)
        for sent_s, value in self._sent:
            if sent_s > now_s:
                x, now_s = self._advance(x, u, sent_s - now_s), sent_s
            u = value
        self._x, self._t_s = self._advance(x, u, max(t_s - now_s, 0.0)), max(t_s, now_s)
        return self._x

    def _advance(self, x, u, time_s):
        Ad, Bd = self._held(time_s)
        return Ad @ x + Bd @ u

    def _held(self, time_s):
        n, m = self._B.shape
        block = np.zeros((n + m, n + m))
        block[:n] = np.hstack([self._A, self._B])
        step = expm(block * time_s)
        return step[:n, :n], step[:n, n:]


def _least_distance(G, h):
    """Return the y of the smallest norm with Gy ≥ h; None if there is none."""
    E = np.vstack([G.T, h])
    goal = np.append(np.zeros(len(G.T)), 1.0)
    multipliers, _ = nnls(E, goal)
    residual = E @ multipliers - goal
    return None if -residual[-1] < 1e-10 else -residual[:-1] / residual[-1]
