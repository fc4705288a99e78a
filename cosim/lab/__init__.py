"""``noack lab``: a page in the browser for trying settings, running live and opening runs.

``lab_server`` serves ``lab_page``; ``lab_services`` computes what it shows. The framework, NiceGUI,
is an extra.
"""
