"""The library in C; clock, random streams, linear systems; errors, files, processes, numbers as text."""
