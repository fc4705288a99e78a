"""Reasons why a process of a run ends, and after what time one that does not respond is lost."""

HORIZON = "horizon"
"""The process has reached the end of the run."""
LAUNCHER_GONE = "the launcher ended early"
LOST_AFTER_S = 8.0
"""A process is lost after this: a connection that a busy machine broke is back by then."""
LAUNCHED_LOST_S = 30.0
"""The same for a process that the launcher started: its exit is seen at once, so there is time."""
