"""What the network part needs itself, and all else with it.

The library in C (``core_library.py``), clock and periods, random streams, the rows of packets; files,
errors, numbers as text, settings (``settings_section.py``, ``toml_file.py``) and extension points;
addresses and UDP sockets, real-time settings; the command line, its streams and the user's private
folder.
"""
