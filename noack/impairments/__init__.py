"""Impairments of a link: one file per loss model, kind of impairment, and queue discipline.

Each file holds the settings, the words of the command line, the description, the prediction and
examples. A file of the same name in native/impairments holds the behaviour. The three packages
import their files automatically; the JSON schema, the emulator, the words, the explanation and the
property tests use what they import.
"""
