"""Figures: functions that draw on the axes of matplotlib.

``run_figures.py``, ``timing_figures.py`` and ``network_figures.py`` draw those of a run; those of a
study are beside it. ``axes_parts.py`` has what they share (curves, marks, axes), ``panels.py`` gives
axes their places and legends, ``page_figure.py`` applies the style sheets, ``figure_files.py`` writes
files.
"""
