"""Identities and bounds of the theory."""
