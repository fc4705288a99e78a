"""Connections of a process with its run, on this host or another one.

``zenoh_session.py`` opens sessions of zenoh over a Unix socket or TLS; ``credentials.py`` has what a
process needs for TLS.
"""
