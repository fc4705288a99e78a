"""A live run: launcher, coordinator, recorder, finalisation."""
