"""The command line ``noack``, by the panels of its help."""

from noack.io.interrupt import quiet_interrupt

with quiet_interrupt():
    # isort: off, in the order of the help
    from cosim.cli import (
        campaigns,
        comparison,
        design,
        doctor,
        files,
        knobs,
        processes,
        runs,
        theory,
    )

    # isort: on
    from cosim.cli.app import app, find_scenario, main

__all__ = [
    "app",
    "campaigns",
    "comparison",
    "design",
    "doctor",
    "files",
    "find_scenario",
    "knobs",
    "main",
    "processes",
    "runs",
    "theory",
]
