"""What a run amounts to: the keys of a summary, for a loop and for the network of all loops.

``summary_model.py`` has the keys. ``loop_statistics.py`` computes statistics of a loop's record,
some of them by ``quantiles.py``; ``run_summary.py`` makes the summary of a loop of them, and
``network_summary.py`` that of the run.
"""
