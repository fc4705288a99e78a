"""``python -m tests.integration.impatient COMMAND…``: noack with short time-outs.

For tests of what follows a time-out; noack's own are long, because machines stall.
"""

from noack.runtime import life_cycle


def main() -> None:
    """Run a command; the processes that it forks have the same time-outs."""
    life_cycle.LOST_AFTER_S, life_cycle.LAUNCHED_LOST_S = 4.0, 8.0
    from cosim.cli import main as noack  # it copies the time-outs
    from cosim.live import launcher  # the same

    launcher._STOP_TIMEOUT_S = 4.0
    noack()


if __name__ == "__main__":
    main()
