"""What all of noack is based on, without knowledge of loops.

``core_library.py`` is the library in C, on which ``linear_systems.py`` and ``random_streams.py``
rest; ``row_operations.py`` has fast operations on many short rows; ``clock.py`` is a run's time.
``errors.py``, ``file_access.py``, ``system_processes.py``, ``number_format.py`` and
``cached_method.py`` have no mathematics.
"""
