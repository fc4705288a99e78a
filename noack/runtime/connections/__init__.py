"""Connections of others: a gate that accepts them, the link to a coordinator, metrics for readers.

``connection_gate.py`` accepts connections on a thread and ends those that flood it. What is served
behind it: ``coordinator_link.py`` forwards processes on other hosts to the coordinator, and
``metrics_server.py`` answers readers of OpenMetrics.
"""
