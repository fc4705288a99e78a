"""A process in a run: its UDP sockets, real-time loop, control plane (zenoh) and telemetry.

Read ``join_run.py`` first, then ``run_process.py`` from top to bottom. They use, in this order:

* ``run_descriptor.py``, with which a process starts,
* ``control_plane.py`` and its messages (``control_messages.py``), over sessions of ``connections``
  (the start barrier is held and opened by the coordinator, in ``cosim/live/coordination``); on another
  host ``host_clocks``, too,
* ``counting_sockets.py``,
* ``drivers``, with the real-time loop,
* ``telemetry.py`` and ``spool.py`` for the rows.

Other programs of the user find a run and change its settings by ``active_runs.py``.
"""
