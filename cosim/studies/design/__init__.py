"""Minimises transmissions by the choice of a trigger, subject to limits; see docs/design.md."""
