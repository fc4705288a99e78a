"""Settings that one drags, and what follows from them: for the lab page and for notebooks.

``scenario_draft`` is the edited scenario; ``sliders`` has its sliders.
``exploration`` (one run, or many) and ``scenario_guarantee`` (certificate and margin) are what
``exploration_figure`` describes, and what ``exploration_words`` states in words. ``draft_results``
computes them for the edited scenario.
"""
