"""The network's process of a run: the relay of :mod:`netem` with the scenario's settings.

``run_network.py`` drives the relay in the core; ``__main__.py`` joins a run, or is the emulator on its
own.
"""
