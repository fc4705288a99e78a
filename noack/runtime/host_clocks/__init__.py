"""The clocks of two hosts: how they are compared, and what a process makes of the comparison.

``clock_offset.py`` bounds the offset, ``time_exchange.py`` exchanges timestamps,
``reference_clock.py`` is the coordinator's clock as another host knows it.
"""
