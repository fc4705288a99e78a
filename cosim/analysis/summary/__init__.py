"""The summary of a run: its keys, those of a loop, and those of the network of all loops.

``summary_model.py`` has the keys. ``loop_statistics.py`` has statistics of a loop's processes and
messages, ``signal_statistics.py`` those of its signals, some of them by ``quantiles.py``;
``loop_summary.py`` makes the summary of a loop of them, and ``run_summary.py`` that of the run.
``plant_linearisation.py`` compares a plant with its loop's model, and ``loops_over_time.py`` has the
loops of a run over time.
"""
