"""Designs of a loop; see docs/design.md.

``design_search.py`` minimises transmissions by the choice of a trigger, subject to limits, among
the candidates of ``design_space.py``. ``event_design.py`` searches for the gain and threshold that
are certified for the largest M. ``network_search.py`` does so for time-triggered loops, with
``hold_strategies.py`` between updates; ``quick_estimate.py`` excludes candidates quickly.
``simplex_search.py`` minimises without gradients.
``design_outcome.py`` has the results of the last two; ``design_page.py`` shows those of all three.
"""
