"""What every process agrees on: scenario, wire format, linear systems, records, clock."""
