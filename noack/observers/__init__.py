"""State observers of the sensor, one kind per file: its settings, estimator and steady state."""
