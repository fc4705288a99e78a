"""Claims checked against a run. A bound holds of a run that conforms to the document that it is proved of.

Besides, each recorded quantity is compared with its bound directly.

1. ``run_certificates.py``: the certificates of a run, with their loop documents.
2. ``observed_conditions.py``: the losses and the times of the loop that occurred; ``condition_reader.py``
   reads them from the record. A run that was later than its scenario allows is compared with a document of
   its lateness.
3. ``run_evidence.py``: what claims are checked against: signals, certificates, and how far the run conforms
   (:mod:`cosim.analysis.conformance`); ``reference_deviations.py``: the record about a set-point;
   ``trajectory_delta.py``: Theorem 1's Δ from a trajectory.
4. ``claim_catalogue.py``: the claims.
5. ``claim_evaluation.py``: checks all of them. ``cosim/output/run_verdict.py`` says of all claims of a
   run whether its guarantee was kept.
"""
