"""Time-triggered loops whose losses are random: moments instead of bounds for all patterns.

The losses are a Markov chain over the packets (``netem/impairments/loss_prediction.py``), with or
without a limit on consecutive losses. From one transmission to the next the state becomes M₀z or
M₁z, so the second moments follow a linear map.

1. ``mean_square_growth.py``. Its spectral radius decides stability in mean square; the bound of the
   radius is computed with all rounding enclosed.
2. ``exact_moments.py``. The same map with disturbances and noise has the stationary moments and the
   mean cost.

For event-triggered loops a campaign estimates means.
"""
