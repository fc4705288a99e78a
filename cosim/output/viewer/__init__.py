"""The view of a run: a rerun recording, shown live or afterwards."""
