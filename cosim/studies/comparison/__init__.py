"""Comparison of two or more runs: numbers, settings, curves."""
