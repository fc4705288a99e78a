"""Live runs. ARCHITECTURE.md, "A run", has their course.

``launcher.py`` starts the processes (``processes``). ``coordinator.py`` admits them, lets them wait
at the start barrier and stops them; those of other hosts come by ``remote_access.py``. The recorder
(``recording``) stores what they send, ``monitoring`` shows it, and ``finalize.py`` completes the
run directory.
"""
