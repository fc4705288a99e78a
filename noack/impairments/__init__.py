"""What a link does to packets: one file per loss model, per kind of impairment, per discipline.

Such a file holds the settings, the behaviour, the words of the command line, the description, the
prediction and examples. The three folders find their files by themselves; the JSON schema, the
compiled emulator, the words, the explanation and the property tests follow from what they find.

A behaviour is a function of numbers and of records (slotted dataclasses with fields of type ``int``
or ``float``), in a subset of Python that numba compiles unchanged: no objects beyond records, no
exceptions, and integers that fit into 64 bits with their sign. The portable emulator runs the
function as it stands, the fast one compiles it.
"""
