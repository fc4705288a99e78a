"""Fate traces: what became of each datagram, recorded as Parquet and taken again in a replay."""
