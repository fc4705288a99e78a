"""The command ``noack``, in this process."""

from functools import cache

import pytest
import typer.main
import typer.testing
from typer.testing import CliRunner, Result

from cosim.cli.application import app
from cosim.live.monitoring import progress_lines

# The commands are built from their signatures once, not for each invocation (0.05 s of CPU).
typer.testing._get_command = cache(typer.main.get_command)
_NEVER_S = 1e6


def invoke(*words: object) -> Result:
    """Run the command with these words; return its exit status and output.

    Lines about long work are left out: a busy machine would print some.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress_lines, "LINE_EVERY_S", _NEVER_S)
        patch.setattr(progress_lines, "FIRST_LINE_S", _NEVER_S)
        patch.setattr("sys.argv", ["noack", *map(str, words)])
        return CliRunner().invoke(app, [str(word) for word in words], prog_name="noack")
