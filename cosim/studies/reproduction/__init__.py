"""Archives of runs, and their repetition."""
