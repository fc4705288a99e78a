"""The controller's process."""

import sys
from collections.abc import Sequence

from netem.core.command_line import stoppable_imports

with stoppable_imports():
    from controller_node.controller import controllers_of
    from netem.core.errors import ExitStatus
    from noack.runtime.join_run import join_run
    from noack.runtime.run_process import run_machines


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the controller of each loop in the run that a recorder or launcher has opened."""
    with join_run("controller", arguments) as run:
        controllers = controllers_of(run.resolved.loops, run.resolved.phases_ns)
        controllers.connect()
        run_machines(run, controllers)
    return ExitStatus.OK


if __name__ == "__main__":
    sys.exit(main())
