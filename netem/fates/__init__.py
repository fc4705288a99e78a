"""Fate traces: the fate of each datagram, recorded as Parquet and repeated in a replay."""
