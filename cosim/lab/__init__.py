"""``noack lab``: a page in the browser for trying settings, running live and opening runs.

The modules that compute know nothing of the page's framework, which is an optional extra:
``exploration`` (one run), ``ensemble`` (many), ``scenario_guarantee`` (certificate and margin),
``draft`` (the edited scenario). The folder ``page`` draws.
"""
