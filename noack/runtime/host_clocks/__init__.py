"""The clocks of two hosts: how they are compared, and what a process makes of the comparison.

``time_exchange.py`` exchanges timestamps, ``reference_clock.py`` is the coordinator's clock as
another host knows it. The bound of the offset is in ``noack/core/clock.py``.
"""
