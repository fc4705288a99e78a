"""Connections: sessions of zenoh, a gate for others, the link to a coordinator, metrics for readers.

``zenoh_session.py`` opens the sessions of control planes, on this host or to another one.
``connection_gate.py`` accepts connections on a thread and ends those that flood it. What is served
behind it: ``coordinator_link.py`` forwards processes on other hosts to the coordinator, and
``metrics_server.py`` answers readers of OpenMetrics.
"""
