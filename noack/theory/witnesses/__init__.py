"""Witnesses: bounds of a loop, found by a solver, for a proof that the kernel verifies.

``documents.py`` searches for all bounds of a loop, ``search.py`` for one at one ν, in the coordinates in
which the solver succeeds; ``line_search.py`` chooses ν, ``effort.py`` counts the work. ``templates.py`` has
the inequalities in floating point, and ``semidefinite.py`` states the problem for Clarabel.
:mod:`noack.proof.elaborate.hybrid_system` has the loop as a hybrid system, and the argument.
"""
