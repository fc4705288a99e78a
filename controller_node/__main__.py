"""The controller's process."""

import sys
from collections.abc import Sequence

from noack.runtime.signals import quiet_interrupt

with quiet_interrupt():
    from controller_node.controller import controller_of
    from noack.core.errors import ExitStatus
    from noack.runtime import process_entry


def main(arguments: Sequence[str] | None = None) -> ExitStatus:
    """Run the controller in the run that a recorder or launcher has opened."""
    return process_entry.main(
        "controller", lambda member: member.run_messages(controller_of), arguments
    )


if __name__ == "__main__":
    sys.exit(main())
