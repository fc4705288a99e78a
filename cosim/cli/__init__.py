"""The command line ``noack``, by the panels of its help."""

from noack.io.interrupt import quiet_interrupt

with quiet_interrupt():
    from cosim.cli import runs, knobs, theory, campaigns, design, processes, files, doctor  # noqa: I001 - in the order of the help
    from cosim.cli.app import app, find_scenario, main

__all__ = [
    "app",
    "campaigns",
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
