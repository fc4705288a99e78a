"""``noack lab``: a page in the browser for trying settings, running live and opening runs.

The modules that compute know nothing of the page's framework, which is an optional extra:
:mod:`cosim.lab.exploration` (one run), :mod:`cosim.lab.ensemble` (many),
:mod:`cosim.lab.scenario_guarantee` (certificate and margin), :mod:`cosim.lab.draft` (the edited
scenario). ``cosim/lab/page/`` draws.
"""
