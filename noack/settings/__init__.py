"""The parts of a loop's settings, above :mod:`netem.core.settings_section`.

``values.py`` has names, rates, vectors and matrices, ``user_files.py`` the files and classes that a
table names.
"""
