"""The plant's process."""

import sys
from collections.abc import Sequence

from noack.runtime.signals import stoppable_imports

with stoppable_imports():
    from noack.core.errors import ExitStatus
    from noack.runtime import process_entry
    from noack.runtime.live_driver import run_machines
    from noack.runtime.process_life import RunProcess
    from plant_server.plant import plants_of


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the plant in the run that a recorder or launcher has opened."""
    return process_entry.main("plant", run_plants, arguments)


def run_plants(process: RunProcess) -> None:
    """Make the plant of each loop, and run them."""
    machines = plants_of(process.loops, process.phases_ns)
    run_machines(process, machines)


if __name__ == "__main__":
    sys.exit(main())
