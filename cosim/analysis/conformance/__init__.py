"""Is a recorded run a run of its loop document?

1. ``trace.py``: what a recorded loop did, in the words of the document: locations, edges and states. It is
   not trusted: a wrong trace is refuted.
2. ``conformance.py``: whether a trace is a run of the document, and shows what was recorded. A bound of the
   document then holds of the run, by the proof.
"""
