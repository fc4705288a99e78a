"""The view of a run for people: a rerun recording, shown live or afterwards."""
