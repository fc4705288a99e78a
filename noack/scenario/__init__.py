"""The scenario: from a file to the numbers of a run.

1. ``sections.py`` and ``run_sections.py``: the tables of a scenario. ``scenario_tables.py``: all of
   them, and what follows from them. ``scenario.py``: with the N loops.
2. ``toml_file.py`` and ``scenario_file.py`` read a file, with one line per mistake;
   ``matrix_files.py`` the matrices that it names.
3. ``scenario_checks.py``: tables that depend on each other; ``overload.py``:
   whether a link can carry what the guarantee makes it carry.
4. ``resolution.py``: names and random draws become numbers. Machines are made of the result.
   ``estimation.py``: the model of its observer.
5. ``runtime_parameters.py`` and ``parameter_changes.py``: changes during a run.
"""
