"""How many loops a link carries: with periodic and with event-triggered transmissions.

``capacity_plan.py`` makes a campaign of the kinds of loops (``loop_kinds.py``),
``capacity_result.py`` finds in its results what limits the number of loops, ``capacity_page.py``
shows it; ``study_time.py`` estimates how long a study takes.
"""
