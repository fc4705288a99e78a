"""Connections: sessions of zenoh, a gate for others, the link to a coordinator.

``zenoh_session.py`` opens the sessions of control planes, on this host or to another one.
``connection_gate.py`` accepts connections on a thread and ends those that flood it; behind it
``coordinator_link.py`` forwards processes on other hosts to the coordinator.
"""
