"""Exports of a run to the files of other programs; one format per file."""
