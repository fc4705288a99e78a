"""Simulation in one process: in virtual time, in exact continuous time, and in compiled batches."""
