"""Identities, bounds and certificates of the theory."""
