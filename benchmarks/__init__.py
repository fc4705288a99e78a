"""Benchmarks: each measures an alternative in the same run, so that noise hits both alike."""
