"""Measures a network: its losses and delays, the M that it has, and models that fit it."""
