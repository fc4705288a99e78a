"""From a resolved scenario to the loop, for those who write documents and search for proofs; not trusted.

Read in this order: :mod:`.loop` (what a statement depends on), :mod:`.model` (the loop as a hybrid system,
with the inequalities of a search), :mod:`.proof` (what a search states and assumes), :mod:`.norms` and
:mod:`.balls` (the arithmetic).
"""
