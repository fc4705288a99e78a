"""Lines on standard error, for whoever runs the emulator."""

import sys
from contextlib import suppress


def say(line: str) -> None:
    """Say something; the emulator goes on if nobody can hear it any more."""
    if sys.stderr is not None:
        with suppress(OSError, ValueError):  # full, a broken pipe; closed
            print(f"noack netem: {line}", file=sys.stderr, flush=True)
