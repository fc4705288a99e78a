"""The commands, one file each.

A file declares its command with :func:`cosim.cli.command.command`: panel, place in it, examples.
Help, completion and the reference page (``tools/reference_pages.py``) are derived from that.
"""
