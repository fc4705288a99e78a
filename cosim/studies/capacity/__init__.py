"""How many loops a link carries: with periodic and with event-triggered transmissions.

``capacity_plan.py`` makes a campaign, ``capacity_result.py`` finds in its results what limits the
number of loops, ``capacity_page.py`` shows it; ``study_time.py`` estimates how long a study takes.
"""
