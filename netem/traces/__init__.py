"""Packets recorded on real networks: sending times, receiving times, losses.

``packet_trace.py`` is what all formats give, with the comparison of two clocks; it finds the format
of a file, and shipped traces. Each other file reads one format. Captures are read packet by packet
(``capture_packets.py``) and become traces in ``capture_trace.py``.
"""
