"""The sensor's process."""

import sys
from collections.abc import Sequence

from noack.runtime.command_line import stoppable_imports

with stoppable_imports():
    from noack.core.errors import ExitStatus
    from noack.runtime import run_process
    from noack.runtime.live_driver import run_machines
    from noack.runtime.run_process import RunProcess
    from sensor_node.sensor import sensors_of


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the sensor in the run that a recorder or launcher has opened."""
    return run_process.main("sensor", run_sensors, arguments)


def run_sensors(process: RunProcess) -> None:
    """Make the sensor of each loop, and run them."""
    machines = sensors_of(process.loops, process.phases_ns, start=process.start, numbered=True)
    run_machines(process, machines)


if __name__ == "__main__":
    sys.exit(main())
