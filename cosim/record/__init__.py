"""The record of a run: its directory, its tables, and their alignment on a common time grid.

Written: ``spool_conversion.py`` converts the spool of a run (``noack/runtime/spool.py``) to
``table_files.py``, one Parquet file per table; ``record_writing.py`` writes the record of a
simulated run, and any run's log. ``collection.py`` adds what other hosts kept.

Read: ``run_directory.py`` finds the files of a run, ``record_source.py`` reads rows batch by batch,
``run_record.py`` has the record of a run and of each loop. From it follow ``run_events.py``
(changes, packet outcomes), ``divergence.py``, ``processes.py`` (final reports, gaps in rows),
``align.py`` (one time grid), ``decimation.py`` (fewer points) and ``data_frames.py``.
"""
