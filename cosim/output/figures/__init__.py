"""Figures: described once, and drawn by matplotlib.

``figure_description.py`` has the parts of a description. Those of a run are made in
``run_figures.py``, ``timing_figures.py`` and ``network_figures.py``, those of a study beside it.
``figure_layout.py`` gives all parts their places, ``figure_drawing.py`` draws them,
``figure_files.py`` writes files.
"""
