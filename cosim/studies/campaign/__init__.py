"""Campaigns: many runs over a grid of settings, with their means and differences.

1. ``campaign_file.py``: what a campaign is. ``campaign_grid.py``: its grid points, each with a
   scenario and the work for its draws.
2. ``random_draws.py``: the draws of a grid point. Ideal loops are followed exactly
   (``cosim/simulation/exact_simulation.py``), others in virtual time (``drawn_runs.py``).
3. ``campaign_workers.py`` computes chunks of draws, ``chunk_store.py`` stores them; all processes
   must have the same code, libraries and arithmetic (``arithmetic.py``).
4. ``metrics.py``: the metrics and their confidence intervals. ``campaign_summary.py``: every metric
   at every grid point.
5. ``campaign_figures.py``, ``campaign_report.py``: figures, page, JSON and tables.
"""
