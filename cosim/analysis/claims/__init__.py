"""Claims checked against a run: held, violated or void, with time and reason.

1. ``observed_conditions.py``: the conditions under which a run took place, and which assumptions
   they violate. ``condition_reader.py`` reads them from the record; ``input_origins.py`` finds out
   which update each input of the plant was computed with.
2. ``run_evidence.py``: signals, conditions and certificates, against which claims are checked;
   ``run_certificates.py`` has the certificates of a run; ``reference_deviations.py``: the record about a
   set-point; ``common_end.py``: a stopped run; ``trajectory_delta.py``: Theorem 1's Δ from a
   trajectory.
3. ``claim_catalogue.py``: the claims.
4. ``claim_evaluation.py``: checks all of them. ``cosim/output/run_verdict.py`` says of all claims of a
   run whether its guarantee was kept.
"""
