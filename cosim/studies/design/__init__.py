"""Chooses a trigger for the fewest transmissions, subject to limits; see docs/design.md."""
