"""A process in a run: its UDP sockets, real-time loop, control plane (zenoh) and telemetry.

Read ``join_run.py`` first, then ``run_process.py`` from top to bottom. They use, in this order:

* ``command_line.py`` and ``run_descriptor.py``, with which a process starts,
* ``control_plane.py``, its messages (``control_messages.py``) and the life cycle that they change
  (``life_cycle.py``); on another host ``connections`` and ``host_clocks``, too,
* ``udp_sockets.py`` with ``address.py``,
* ``real_time_loop.py``, whose driver is ``live_driver.py`` or ``node_driver.py``,
* ``telemetry.py`` and ``spool.py`` for the rows; ``private_folder.py`` for files of the user.
"""
