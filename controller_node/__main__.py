"""The controller's process."""

import sys
from collections.abc import Sequence

from noack.runtime.signals import stoppable_imports

with stoppable_imports():
    from controller_node.controller import controllers_of
    from noack.core.errors import ExitStatus
    from noack.runtime import process_entry
    from noack.runtime.live_driver import run_machines
    from noack.runtime.process_life import RunProcess


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the controller in the run that a recorder or launcher has opened."""
    return process_entry.main("controller", run_controllers, arguments)


def run_controllers(process: RunProcess) -> None:
    """Make the controller of each loop, and run them."""
    machines = controllers_of(process.loops, process.phases_ns, start=process.start)
    run_machines(process, machines)


if __name__ == "__main__":
    sys.exit(main())
