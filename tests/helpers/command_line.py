"""The command ``noack``, in this process."""

from functools import cache

import typer.main
import typer.testing
from typer.testing import CliRunner, Result

from cosim.cli.application import app

# The commands are built from their signatures once, not for each invocation (0.05 s of CPU).
typer.testing._get_command = cache(typer.main.get_command)


def invoke(*words: object) -> Result:
    """Run the command with these words; return its exit status and output."""
    return CliRunner().invoke(app, [str(word) for word in words], prog_name="noack")
