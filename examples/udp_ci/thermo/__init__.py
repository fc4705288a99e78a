"""Temperatures over UDP: a server, and a client that repeats its question."""
