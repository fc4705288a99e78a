"""The scenario file: sections, file readers, validation messages, resolution."""
