"""The record of a run: its directory, its tables, aligned on a common time grid."""
