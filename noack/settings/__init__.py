"""The parts of settings.

``section.py`` has tables, kinds, vectors and matrices, ``user_files.py`` the files and classes that a
table names.
"""
