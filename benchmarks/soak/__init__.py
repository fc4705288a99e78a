"""The soak: a real run, watched from outside for hours.

``python -m benchmarks.soak`` is one hour at speed 1, then a day of simulated time at speed 48.
"""
