"""The soak test: a real run of several hours, observed from outside.

``python -m benchmarks.soak`` runs one hour at speed 1, then a day of simulated time at speed 48.
"""
