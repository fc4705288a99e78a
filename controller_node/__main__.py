"""The controller's process."""

import sys
from collections.abc import Sequence

from noack.runtime.signals import stoppable_imports

with stoppable_imports():
    from controller_node.controller import controller_of
    from controller_node.controller_arrays import CONTROLLER_FLEET
    from noack.core.errors import ExitStatus
    from noack.runtime import process_entry
    from noack.runtime.loop_machines import run_machines


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the controller in the run that a recorder or launcher has opened."""
    return process_entry.main(
        "controller",
        lambda process: run_machines(process, controller_of, CONTROLLER_FLEET),
        arguments,
    )


if __name__ == "__main__":
    sys.exit(main())
