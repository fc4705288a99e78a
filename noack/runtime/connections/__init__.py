"""Connections of a process with other programs of noack.

``zenoh_session.py`` opens sessions of zenoh on a Unix socket, or with another host by TLS;
``credentials.py`` has what a process on another host needs for that.
"""
