"""The processes of a live run, and those that help with its end."""
