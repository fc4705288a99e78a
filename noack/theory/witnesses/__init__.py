"""Witnesses: bounds of a loop, found by a solver, and proven by :mod:`noack_check`.

``documents.py`` searches for all bounds of a loop; ``search.py`` for one, with the coordinates in which
the solver succeeds; ``semidefinite.py`` states the problem for Clarabel. :mod:`noack_check.model` has the
loop as a hybrid system, and the argument.
"""
