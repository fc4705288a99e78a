"""What shows a live run to programs outside of noack."""
