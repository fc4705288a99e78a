"""The commands, those of one subject in a file.

A file declares its commands with :func:`cosim.cli.command.command`: panel, and place in it. The
help of the options and the examples are in the docstrings. Help, completion and the reference page
(``tools/reference_pages.py``) are derived from that.
"""
