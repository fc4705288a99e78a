"""The view of a run: a rerun recording, shown live or afterwards.

``recording.py`` writes a recording with the layout of ``blueprint.py``. ``table_feed.py`` feeds it
with the tables of a loop, ``run_recording.py`` with all loops of a run, ``run_feed.py`` while the
run goes on. ``network_diagram.py`` and ``pictures`` are animations in it. ``live_viewer.py`` shows
it, in ``rerun_program.py``.
"""
