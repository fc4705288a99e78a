"""The margin: whether a loop is stable for every loss pattern that a guarantee allows.

Here the sensor is time-triggered, or has a longest time between two events. Nothing about the
threshold is used, so the result is exact where certificates are sufficient only (docs/theory.md,
"The margin of a time-triggered loop"; the paper's M is the only thing of it that remains).

1. ``time_triggered_loop.py``. A delivered update removes all knowledge of older ones. So from one
   delivery to the next the loop is one linear map, z → Φ z, that depends on the number of lost
   updates between, on the times, and on the controller's ticks. The maps are computed without
   rounding (``exact_matrices.py``) and enclosed.
2. ``loss_margin.py``. The guarantee is an automaton; its states at deliveries are the nodes of a
   graph, the bursts it allows are the edges. Every pattern is a path. With the maps as matrices of
   the edges this is a switched system (``switched_system.py``).
3. All patterns are stable exactly if the joint spectral radius of this system is below 1
   (``joint_spectral_radius.py``). A cycle of the graph bounds it from below, and is a pattern that
   destabilises the loop if its radius is above 1 (``switched_system.py``). Polytopes that the maps
   take into each other bound it from above (``invariant_polytopes.py``); where there are too many
   edges, quadratic norms do (``joint_spectral_radius.py``).

How the polytopes, norms and cycles are found is a heuristic in floating point. What they prove is
computed afterwards from what was found, with all rounding, by ``exact_matrices.py``. If the bounds
are on both sides of 1, the result is "undecided".
"""
