"""``noack lab``: a page in the browser for trying settings, running live and opening runs.

``lab_server.py`` serves ``lab_page.py``, whose menu is ``file_menu.py``; ``lab_services.py`` computes
what it shows. ``figure_sources.py`` has what its figure can show besides an explored run,
``recorded_views.py`` the views of live and recorded runs, ``live_run.py`` a live run in a process of
its own. The browser gets ``page_parts.py``, ``lab.js`` (the page) and ``figure.js`` (the figure). The
framework, NiceGUI, is an extra.
"""
