"""The command line ``noack``, by the panels of its help."""

from noack.runtime.interrupt import quiet_interrupt

with quiet_interrupt():
    # isort: off, in the order of the help
    from cosim.cli import (
        campaign_commands,
        compare_commands,
        design_command,
        doctor_command,
        file_commands,
        process_commands,
        run_commands,
        set_command,
        theory_commands,
    )

    # isort: on
    from cosim.cli.command import app, find_scenario, main

__all__ = [
    "app",
    "campaign_commands",
    "compare_commands",
    "design_command",
    "doctor_command",
    "file_commands",
    "find_scenario",
    "main",
    "process_commands",
    "run_commands",
    "set_command",
    "theory_commands",
]
