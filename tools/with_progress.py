"""Run a command, and say every 8 s that it still runs: ``with_progress.py [--late] WHAT COMMAND ...``.

The first line is printed at once, or with ``--late`` only if the command takes that long. The exit
status is that of the command.
"""

import subprocess
import sys
import time
from collections.abc import Sequence

_EVERY_S = 8.0


def run(what: str, command: Sequence[str], *, is_late: bool, every_s: float = _EVERY_S) -> int:
    """Run a command with lines about it; return its exit status."""
    if not is_late:
        print(f"{what} ...", flush=True)
    began_s = time.monotonic()
    with subprocess.Popen(command) as process:
        while True:
            try:
                status = process.wait(every_s)
            except subprocess.TimeoutExpired:
                print(f"{what}: {time.monotonic() - began_s:.0f} s so far", flush=True)
            except KeyboardInterrupt:  # the command received it, too
                process.wait()
                return 130
            else:
                return 128 - status if status < 0 else status


if __name__ == "__main__":
    *options, name = sys.argv[1:2] if sys.argv[1] != "--late" else sys.argv[1:3]
    sys.exit(run(name, sys.argv[2 + len(options) :], is_late=bool(options)))
