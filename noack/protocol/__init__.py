"""What the processes exchange: wire format, roles, record tables."""
