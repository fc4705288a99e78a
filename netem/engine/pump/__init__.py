"""The pump: the compiled loop (numba) of the Linux engine, which runs between returns to Python."""
