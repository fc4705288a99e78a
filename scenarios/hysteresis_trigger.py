"""A trigger of one's own: the paper's threshold, on a grid and with hysteresis."""

import math

import numpy as np


class HysteresisTrigger:
    """Transmit at grid times when ‖e_s‖ exceeds a threshold, and repeat while it is just below.

    After an event caused by the threshold, the threshold is lowered to ``lower`` times itself for
    ``repeat_s``: a second update follows soon if the error grows on, in case the first was lost.

    Args:
        beta: threshold at t = 0.
        alpha_per_s: its decay.
        period_s: the grid.
        lower: in (0, 1].
        repeat_s: how long the lowered threshold holds after an event.
    """

    def __init__(self, beta, alpha_per_s, period_s, lower, repeat_s):
        if not 0 < lower <= 1:
            raise ValueError(f"lower is {lower}; it must be above 0 and at most 1")
        self.beta, self.alpha_per_s = beta, alpha_per_s
        self.period_s, self.lower, self.repeat_s = period_s, lower, repeat_s
        self.event_s = -math.inf

    def start(self, t_s, x):
        """The run starts, or the measurement just tested was an event."""
        if t_s > 0:
            self.event_s = t_s

    def test(self, t_s, x, e_s):
        """Return what is compared: the sensor transmits if the first exceeds the second."""
        threshold = self.beta * math.exp(-self.alpha_per_s * t_s)
        if t_s - self.event_s < self.repeat_s:
            threshold *= self.lower
        periods = t_s / self.period_s
        on_grid = abs(periods - round(periods)) < 1e-6
        return (float(np.linalg.norm(e_s)) if on_grid else 0.0), threshold
