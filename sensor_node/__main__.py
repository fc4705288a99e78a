"""The sensor's process."""

import sys
from collections.abc import Sequence

from netem.core.command_line import stoppable_imports

with stoppable_imports():
    from netem.core.errors import ExitStatus
    from noack.runtime.join_run import join_run
    from noack.runtime.run_process import run_machines
    from sensor_node.sensor import sensors_of


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the sensor of each loop in the run that a recorder or launcher has opened."""
    with join_run("sensor", arguments) as run:
        sensors = sensors_of(run.resolved.loops, run.resolved.phases_ns)
        run_machines(run, sensors)
    return ExitStatus.OK


if __name__ == "__main__":
    sys.exit(main())
