"""The command ``noack``, in this process."""

from typer.testing import CliRunner, Result

from cosim.cli import app


def invoke(*words: object) -> Result:
    """Run the command with these words; return its exit status and output."""
    return CliRunner().invoke(app, [str(word) for word in words], prog_name="noack")
