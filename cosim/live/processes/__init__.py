"""The processes of a live run, and those for its end.

``child_processes.py`` forks those of the run; ``early_certificates.py`` has a process that computes
certificates while the run goes on; ``process_pool.py`` has processes for its end.
"""
