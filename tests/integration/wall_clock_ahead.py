"""noack on a host whose wall clock is 0.3 s ahead of the others'."""

import time

from cosim.cli import main

_time_ns = time.time_ns
time.time_ns = lambda: _time_ns() + 300_000_000
main()
