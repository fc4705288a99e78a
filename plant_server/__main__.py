"""The plant's process."""

import sys
from collections.abc import Sequence

from noack.runtime.signals import stoppable_imports

with stoppable_imports():
    from noack.core.errors import ExitStatus
    from noack.runtime import process_entry
    from noack.runtime.loop_machines import run_machines
    from plant_server.plant import plant_of
    from plant_server.plant_arrays import PLANT_FLEET


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the plant in the run that a recorder or launcher has opened."""
    return process_entry.main(
        "plant",
        lambda process: run_machines(process, lambda loop, _: plant_of(loop), PLANT_FLEET),
        arguments,
    )


if __name__ == "__main__":
    sys.exit(main())
