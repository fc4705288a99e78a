"""Is a recorded run a run of its loop document?

1. ``run_document.py``: a loop document with what its names mean. A loop whose bounds have a proof by
   gains gets a document without a proof.
2. ``trace.py``: what a recorded loop did, in the words of the document: locations, edges and states. It is
   not trusted: a wrong trace is refuted. ``input_origins.py`` finds out which update each input of the
   plant was computed with; ``common_end.py``: a stopped run.
3. ``conformance.py``: whether a trace is a run of the document, and shows what was recorded. A bound of the
   document then holds of the run, by the proof.
4. ``run_conformance.py``: both, of a record. ``verdicts.py``: the result.
"""
