"""Connections of a process with a run on another host.

``credentials.py`` has what a process needs for a session of zenoh by TLS
(:mod:`netem.control.zenoh_session`).
"""
