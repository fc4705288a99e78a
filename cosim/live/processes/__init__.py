"""The processes of a live run, and those that help with its end.

``child_processes.py`` forks those of the run; ``process_pool.py`` has workers, with which
``finalize_helpers.py`` writes the tables of a run at its end.
"""
