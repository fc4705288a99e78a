"""Live runs. ARCHITECTURE.md, "A run", has their course.

``launcher.py`` starts the processes (``processes``), ``coordinator.py`` lets them join and stops
them, with those of other hosts by ``remote_access.py``. The recorder (``recording``) stores what
they send, ``monitoring`` shows it, and ``finalize.py`` completes the run directory.
"""
