"""Driving the machines of a process during a run.

``real_time_loop.py`` has the loop, ``realtime_settings.py`` the settings of the operating system. The
driver is ``live_driver.py``.
"""
