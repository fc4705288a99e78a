"""Packets recorded on real networks: sending times, receiving times, losses."""
