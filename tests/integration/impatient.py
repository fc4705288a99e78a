"""``python -m tests.integration.impatient COMMAND…``: noack with short time-outs.

For tests of what follows a time-out; noack's own are long, because machines stall. The process of the
role in the environment's ``FROZEN``, if any, stops before it requests admission.
"""

import os
import signal

from noack.runtime import end_reasons, join_run
from noack.runtime.connections import zenoh_session

LEASE_S = 2.0
"""A connection whose other end is silent for longer breaks."""


def stop_if_frozen(title: str) -> None:
    """Set the title of a process, and stop it if it is the frozen one."""
    _setproctitle(title)
    if title == f"noack {os.environ.get('FROZEN')}":
        os.kill(os.getpid(), signal.SIGSTOP)


_setproctitle = join_run.setproctitle


def main() -> None:
    """Run a command; the processes that it forks have the same time-outs."""
    end_reasons.LOST_AFTER_S, end_reasons.LAUNCHED_LOST_S = 4.0, 5.0
    zenoh_session._LEASE_MS = round(1e3 * LEASE_S)
    join_run.setproctitle = stop_if_frozen
    from cosim.cli import main as noack  # it copies the time-outs
    from cosim.live import launcher  # the same

    launcher._STOP_TIMEOUT_S = 2.0
    noack()


if __name__ == "__main__":
    main()
