"""Settings that one drags, and what follows from them: for the lab page and for notebooks.

``draft`` is the edited scenario; ``controls`` has its sliders, ``form`` all its keys.
``exploration`` (one run, or many) and ``scenario_guarantee`` (certificate and margin) are what
``exploration_figure`` describes.
"""
