"""Lines on standard error for the user of the emulator."""

from noack.runtime.command_line import print_to_stderr


def say(line: str) -> None:
    """Write a line; if standard error is closed, the emulator continues."""
    print_to_stderr(f"noack netem: {line}")
