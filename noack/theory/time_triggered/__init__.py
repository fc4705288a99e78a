"""Loops whose sensor transmits at times that do not depend on measurements: their times, maps and patterns.

1. ``scenario_times.py`` has the times of a scenario's loop, and refuses loops without them.
2. ``time_triggered_loop.py`` has the maps of the loop from one transmission to the next, without rounding
   (``exact_matrices.py``): for the growth and the moments under random losses.
3. ``graph.py``: paths of bursts, and which of their cycles grows most. It is a heuristic for the search of
   witnesses (:mod:`noack.theory.witnesses.growth`) and of gains.
"""
