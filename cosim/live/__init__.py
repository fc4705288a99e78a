"""Live runs. ARCHITECTURE.md, "A run", has their course.

``launcher.py`` starts the processes (``processes``) if the record fits on the disk
(``disk_space.py``), and waits for them, longer on a loaded machine (``wait_limit.py``). The
coordinator (``coordination``) admits them, lets them wait at the start barrier and stops them, also
those of other hosts. The recorder (``recording``) stores what they send, ``monitoring`` shows it,
and ``finalize.py`` completes the run directory, also of a simulated run.
"""
