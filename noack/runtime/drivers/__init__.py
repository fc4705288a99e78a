"""Driving the machines of a process during a run.

``real_time_loop.py`` has the loop, :mod:`netem.core.realtime_settings` the settings of the operating
system. The driver is ``live_driver.py``.
"""
