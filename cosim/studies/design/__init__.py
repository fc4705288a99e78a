"""Designs of a loop; see docs/design.md.

``design_search.py`` minimises transmissions by the choice of a trigger, subject to limits, among
the candidates of ``design_space.py``. ``network_search.py`` searches for the gain of a
time-triggered loop that tolerates the most losses; ``quick_estimate.py`` excludes candidates
quickly. ``design_outcome.py`` has the results of the latter; ``design_page.py`` shows those of both.
"""
