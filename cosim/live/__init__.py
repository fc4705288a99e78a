"""Live runs. ARCHITECTURE.md, "A run", has their course.

``launcher.py`` starts the processes (``processes``). The coordinator (``coordination``) admits them,
lets them wait at the start barrier and stops them, also those of other hosts. The recorder
(``recording``) stores what they send, ``monitoring`` shows it, and ``finalize.py`` completes the
run directory.
"""
