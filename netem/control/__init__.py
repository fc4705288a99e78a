"""Live control of a relay: statistics, changes while it runs, a view in the terminal.

``command_queue.py`` reaches the relay, ``emulator_statistics.py`` makes its statistics,
``metrics_text.py`` writes them for Prometheus. ``control_routes.py`` answers requests, which
``http_server.py`` receives; ``control_server.py`` starts it. ``running_emulators.py`` has the files by
which ``control_client.py`` and ``emulator_commands.py`` find a running emulator.
"""
