"""What settings are made of: tables, vectors and matrices, files that a table names."""
