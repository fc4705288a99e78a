"""``noack lab``: a page in the browser for trying settings, running live and opening runs.

The folder ``page`` draws what :mod:`cosim.interactive` computes; its framework is an extra.
"""
