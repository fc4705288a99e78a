"""Event-triggering policies, one per file."""
