"""Measures a network: its losses and delays, the most losses in a row, and models that fit it.

From a packet trace to the measurement, in this order:

1. ``trace_sources.py`` reads a trace from files.
2. ``loss_bursts.py``: which packets are effective, and the bursts of consecutive losses.
3. ``chain_fits.py``: loss models that fit the bursts, with confidence intervals of
   ``interval_estimates.py``; ``outages.py``: bursts that are too long for them.
4. ``network_measurement.py``: all of this as one object.
"""
