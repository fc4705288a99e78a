"""The processes of a live run, and those that help with its end.

``fork_server.py`` starts processes that have imported everything; ``child_processes.py`` starts
them; ``process_pool.py`` has workers, with which
``finalize_helpers.py`` writes the tables of a run at its end.
"""
