"""The margin: whether a loop is stable for every loss pattern that a guarantee allows.

Here the sensor is time-triggered, or has a longest time between two events. The threshold is not
used; of the paper's assumptions only M remains. The result is necessary and sufficient, whereas
certificates are sufficient only (docs/theory.md, "The margin of a time-triggered loop").

1. ``time_triggered_loop.py``. A delivered update removes all knowledge of older ones. So from one
   delivery to the next the loop is one linear map, z → Φ z, that depends on the number of lost
   updates between, on the times, and on the controller's ticks. The maps are computed without
   rounding (``exact_matrices.py``) and enclosed. ``scenario_times.py`` has the times of a
   scenario's loop, and refuses loops without them.
2. ``loss_margin.py``. The guarantee is an automaton; its states at deliveries are the nodes of a
   graph, the bursts it allows are the edges. Every pattern is a path. With the maps as matrices of
   the edges this is a switched system (``switched_system.py``).
3. All patterns are stable exactly if the joint spectral radius of this system is below 1
   (``joint_spectral_radius.py``). A cycle of the graph bounds it from below, and is a pattern that
   destabilises the loop if its radius is above 1 (``switched_system.py``). From above it is bounded
   by polytopes that the maps take into each other (``invariant_polytopes.py``), by quadratic norms
   (``quadratic_norms.py``), and by products of many maps.

A heuristic in floating point searches for the polytopes, norms and cycles. ``exact_matrices.py``
then verifies what they prove, with all rounding errors included. If the lower bound is below 1 and
the upper bound above 1, the result is "undecided".
"""
