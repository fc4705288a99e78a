"""Simulation in one process; the core (native/) makes the steps.

:mod:`.virtual_time` runs N ≥ 1 loops without a clock. :mod:`.exact_simulation` is the core's exact
simulator in continuous time, for many runs at once; :mod:`.continuous` has single runs of it.
:mod:`.sampled_loop` follows many runs of the processes' loop from event to event.
"""
