"""Who follows a live run: terminal and log."""
