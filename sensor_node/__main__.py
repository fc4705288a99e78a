"""The sensor's process."""

import sys
from collections.abc import Sequence

from noack.runtime.signals import stoppable_imports

with stoppable_imports():
    from noack.core.errors import ExitStatus
    from noack.runtime import process_entry
    from noack.runtime.loop_machines import run_machines
    from sensor_node.sensor import sensor_of
    from sensor_node.sensor_arrays import SENSOR_FLEET


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the sensor in the run that a recorder or launcher has opened."""
    return process_entry.main(
        "sensor", lambda process: run_machines(process, sensor_of, SENSOR_FLEET), arguments
    )


if __name__ == "__main__":
    sys.exit(main())
