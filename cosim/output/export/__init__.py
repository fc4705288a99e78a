"""Exports of a run to the files of other programs.

``export_formats.py`` finds the format of a file and what it is given; each format is a file
``NAME_export.py`` in this folder.
"""
