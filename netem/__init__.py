"""A user-space network emulator for UDP that guarantees at most M-1 successive drops per flow."""
