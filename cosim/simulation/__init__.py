"""Runs without processes: in virtual time, in exact continuous time, and compiled in batches."""
