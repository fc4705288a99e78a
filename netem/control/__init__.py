"""Live control of a relay: statistics, changes while it runs, a view in the terminal.

``command_queue.py`` reaches the relay, ``emulator_statistics.py`` makes its statistics,
``running_emulators.py`` has the files by which commands find it. ``control_server.py`` answers queries
and ``emulator_commands.py`` sends them, by zenoh (``zenoh_session.py``): a relay without ``--control``
imports none of these three.
"""
