"""Settings that one drags, and what follows from them: for the lab page and for notebooks.

``draft`` is the edited scenario, ``controls`` its sliders; ``exploration`` (one run), ``ensemble``
(many) and ``scenario_guarantee`` (certificate and margin) are what is drawn.
"""
