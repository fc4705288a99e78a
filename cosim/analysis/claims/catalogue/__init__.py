"""The claims: the definitions of :mod:`cosim.analysis.claims.claim_definition` in the modules."""
