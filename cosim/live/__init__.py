"""Live runs: launcher, coordinator, recorder, finalisation."""
