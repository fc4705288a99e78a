"""The record of a run: its directory, its tables, and their alignment on a common time grid.

Written: ``spool_conversion.py`` converts the spool of a run (``noack/runtime/spool.py``) to
``table_files.py``, one Parquet file per table; ``record_writing.py`` writes the record of a
simulated run, and any run's log. ``added_rows.py`` adds what other hosts kept.

Read: ``run_directory.py`` finds the files of a run, ``run_record.py`` has the record of a run and of
each loop, whose tables are read as a whole or part by part; ``rows.py`` says which rows of a run are
of which loop. From the record follow ``run_events.py`` (changes, packet outcomes),
``divergence.py``, ``processes.py`` (final reports, gaps in rows), ``align.py`` (one time grid),
``decimation.py`` (fewer points) and ``data_frames.py``.
"""
