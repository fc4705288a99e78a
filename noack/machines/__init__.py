"""The machines of the core and their Python side: memory, users' code, changes, rows, log lines."""
