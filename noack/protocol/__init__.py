"""What the processes exchange: wire format, topology, machine interface, record tables."""
