"""The parts of settings: tables, vectors and matrices, files that a table names."""
