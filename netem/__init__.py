"""A user-space UDP network emulator that guarantees at most M - 1 consecutive losses per flow."""
