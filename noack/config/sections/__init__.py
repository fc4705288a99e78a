"""The sections of a scenario file, one part of the system each."""
