"""The coordinator of a live run, which holds and opens the start barrier; how other hosts reach it."""
