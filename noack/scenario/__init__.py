"""The scenario file: its tables and their checks, files that it names, names and draws as numbers."""
