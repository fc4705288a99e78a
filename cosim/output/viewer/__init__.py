"""The view of a run: a rerun recording, shown live or afterwards.

``loop_recording.py`` writes what a recording shows of a loop, and ``run_recording.py`` that of all
loops of a run, with the layout of ``blueprint.py``. ``loop_feed.py`` feeds it with the tables of a
loop, ``live_feed.py`` with the rows of a run while it goes on. ``network_diagram.py`` and
``pictures`` are animations in it. ``recording_viewer.py`` shows it, in ``rerun_program.py``.
"""
