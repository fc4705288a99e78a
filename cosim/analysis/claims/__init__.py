"""Claims checked against a run: held, violated or void, with time and reason."""
