"""Functional Mock-up Units as plants of noack: ``plant.system.kind = "fmu"``."""
