"""Replays a long run in a process of its own, while its launcher computes the rest of its end."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from cosim.analysis.replay import replay
from cosim.live.fork_server import ENVIRONMENT
from cosim.record.run_record import RunRecord, load_record
from noack.core.process_limits import python_command
from noack.protocol.record_tables import PLANT_STEP
from noack.protocol.topology import LOOP_ROLES

_ENVIRONMENT = ENVIRONMENT | dict.fromkeys(
    ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"), f"{32 * 2**20}"
)
"""It keeps freed memory: half of its time would be page faults, if each part of the record had new
memory."""
_LEAST_STEPS = 50_000
"""The replay of a shorter run takes less time than the start of a process."""


class ReplayProcess:
    """The process that replays the record of a run directory; none for a short run.

    It ends with this process, and with the context.
    """

    def __init__(self, record: RunRecord, run_dir: Path) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if record.kind != "live" or record.roles != LOOP_ROLES:
            return  # loops that share a network have a process for each core
        if record.count(PLANT_STEP) < _LEAST_STEPS:
            return
        with suppress(OSError):  # the run is replayed in this process then
            self._process = subprocess.Popen(
                python_command("-m", __spec__.name, run_dir.absolute()),
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
                env=os.environ | _ENVIRONMENT,
            )  # fmt: skip

    def verdict(self) -> dict[str, Any] | None:
        """Wait for the result for the run's summary; None if the process could not replay it."""
        if self._process is None or self._process.stdout is None:
            return None
        try:
            found = json.loads(self._process.stdout.read())
        except (OSError, ValueError):
            return None
        return found if isinstance(found, dict) else None

    def __enter__(self) -> "ReplayProcess":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            with suppress(OSError):
                self._process.communicate()


def main(arguments: Sequence[str]) -> None:
    """Replay the record of a run directory; print the result for its summary as JSON."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    (run_dir,) = arguments
    with np.errstate(all="ignore"):
        print(json.dumps(replay(load_record(Path(run_dir))).verdict()))


def _end_with_parent() -> None:
    """End this process when the parent, which holds the other end of standard input, has ended."""
    with suppress(OSError):
        os.read(sys.stdin.fileno(), 1)
    os._exit(1)


if __name__ == "__main__":
    main(sys.argv[1:])
