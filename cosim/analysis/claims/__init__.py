"""Claims checked against a run: held, violated or void, with time and reason.

1. ``observed_conditions.py``: the conditions under which a run took place, and which assumptions
   they violate. ``condition_reader.py`` reads them from the rows of the record;
   ``input_origins.py`` finds out which update each input of the plant was computed with.
2. ``run_evidence.py``: signals, conditions and certificates, against which claims are checked;
   ``run_certificates.py`` searches for the certificates of several runs together;
   ``trajectory_delta.py``: Theorem 1's Δ from a trajectory.
3. ``claim_catalogue.py``: the claims.
4. ``claim_evaluation.py``: checks all of them, for each part of a run; ``run_parts.py`` cuts its
   record into these parts.
"""
