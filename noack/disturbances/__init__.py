"""Disturbances of a plant, one kind per file: its settings and its signal."""
