"""The plant's process."""

import sys
from collections.abc import Sequence

from netem.core.command_line import stoppable_imports

with stoppable_imports():
    from netem.core.errors import ExitStatus
    from noack.runtime.join_run import join_run
    from noack.runtime.run_process import run_machines
    from plant_server.plant import plants_of


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the plant of each loop in the run that a recorder or launcher has opened."""
    with join_run("plant", arguments) as run:
        plants = plants_of(run.resolved.loops, run.resolved.phases_ns)
        plants.connect()
        run_machines(run, plants)
    return ExitStatus.OK


if __name__ == "__main__":
    sys.exit(main())
