"""Benchmarks: each also measures an alternative in the same run, so that noise affects both."""
