"""Many exact runs of the paper's loop, each with its own plant, start and losses."""
