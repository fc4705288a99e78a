"""Impairments of a link: one file per loss model, kind of impairment, and queue discipline.

Each file holds the settings, the behaviour, the words of the command line, the description, the
prediction and examples. The three packages import their files automatically; the JSON schema, the
compiled emulator, the words, the explanation and the property tests use what they import.

A behaviour is a function of numbers and of records (slotted dataclasses with fields of type ``int``
or ``float``), in a subset of Python that numba compiles unchanged: no objects beyond records, no
exceptions, and integers that fit into 64 bits with their sign. The portable emulator runs the
function as plain Python, the fast one compiles it.
"""
