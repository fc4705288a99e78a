"""What a run shows of what was claimed for it: held, violated, or void since when and why."""
