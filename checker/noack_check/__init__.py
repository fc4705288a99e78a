"""Verifies the witnesses of noack's bounds; imports nothing of noack.

Read in this order: :mod:`.loop` (what a statement depends on), :mod:`.model` (the loop as a hybrid
system, and the inequalities that prove a bound, with the argument), :mod:`.proof` (what follows for the
errors and the times between events), :mod:`.norms` and :mod:`.balls` (the arithmetic).
"""
