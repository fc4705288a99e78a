"""The sensor's process."""

import sys
from collections.abc import Sequence

from noack.runtime.signals import stoppable_imports

with stoppable_imports():
    from noack.core.errors import ExitStatus
    from noack.runtime import process_entry
    from noack.runtime.live_driver import run_machines
    from noack.runtime.process_life import RunProcess
    from sensor_node.sensor import sensors_of


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the sensor in the run that a recorder or launcher has opened."""
    return process_entry.main("sensor", run_sensors, arguments)


def run_sensors(process: RunProcess) -> None:
    """Make the sensor of each loop, and run them."""
    machines = sensors_of(process.loops, process.phases_ns, start=process.start)
    run_machines(process, machines)


if __name__ == "__main__":
    sys.exit(main())
