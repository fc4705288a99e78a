"""Launches a run and prints its directory; the record stays in the spool."""

import sys
from pathlib import Path

from cosim.live.launcher import launch
from noack.config.scenario_file import load

if __name__ == "__main__":
    ending = launch(load(Path(sys.argv[1])), Path(sys.argv[2]))
    print(ending.run_dir, int(ending.status), ending.reason, sep="\n", flush=True)
