"""Proofs as files: a loop document, which people read, and a proof of its bounds for the kernel.

``elaborate/`` leads from a resolved scenario to the loop as a hybrid system, ``search/`` has what a search
finds of it. Then

1. ``loop_document.py``: the document of a loop, from the model in which the search proves its bounds.
2. ``forms_proof.py``: the proof of a document, from what the search has found.
3. ``words.py``: a document as text.

Nothing here is trusted: the kernel verifies the files, and knows neither a loop nor a search.
``docs/proof-format.md`` has the formats and the rules.
"""
