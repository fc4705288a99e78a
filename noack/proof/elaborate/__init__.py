"""The elaborator: from a resolved scenario to the loop as numbers, and as a hybrid system. It is not trusted.

Documents are written from the hybrid system (:mod:`noack.proof`), and a search has its inequalities
(:mod:`noack.proof.search`). Read in this order: :mod:`.loop` (what a statement depends on), :mod:`.scenario`
(how it is read), :mod:`.hybrid_system` (locations, flows and edges, with the inequalities of a search).
"""
