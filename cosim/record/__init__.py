"""The record of a run: its directory, its tables, and their alignment on a common time grid."""
