"""The pump: what the Linux engine does between two returns to Python, compiled by numba."""
