"""Links described by words: the syntax of ``tc netem``, links files, and explanations."""
