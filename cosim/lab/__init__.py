"""``noack lab``: a page in the browser for trying settings, running live and opening runs.

``lab_server`` serves ``lab_page``, which has a panel in each of the other files; ``chart`` draws
the figure of :mod:`cosim.interactive`. The framework, NiceGUI, is an extra.
"""
